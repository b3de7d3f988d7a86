"""Copies of run folders at addresses."""

import json
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from memcomp_lightning.errors import UserError
from memcomp_lightning.runs import addresses
from memcomp_lightning.runs.addresses import (
    Copy,
    NotCopiedError,
    address_of,
    check_address,
    copying,
    fetch,
    fetched,
    is_address,
    read_at,
)

AT = "memory://bucket/runs/mine"

Store = fsspec.AbstractFileSystem


@pytest.fixture
def store() -> Iterator[Store]:
    memory = fsspec.filesystem("memory")
    yield memory
    if memory.exists("/bucket"):
        memory.rm("/bucket", recursive=True)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "mine"
    (folder / "weights").mkdir(parents=True)
    (folder / "checkpoints/pretrain").mkdir(parents=True)
    (folder / "overrides.json").write_text("{}")
    (folder / "weights/pretrain.pt").write_bytes(b"weights")
    (folder / "checkpoints/pretrain/last.ckpt").write_bytes(b"checkpoint")
    (folder / "stages.json").write_text('{"pretrain": {}}')
    (folder / ".lock").write_text("held")
    (folder / ".weights.host.1.partial").write_text("half")
    return folder


RUN = {"overrides.json", "weights/pretrain.pt", "checkpoints/pretrain/last.ckpt", "stages.json"}
CHECKPOINT = "checkpoints/pretrain/last.ckpt"


def names(store: Store) -> set[str]:
    found = {path.removeprefix("/bucket/runs/mine/") for path in store.find("/bucket/runs/mine")}
    return found - {addresses.OWNER}


@pytest.mark.parametrize("text", ["s3://bucket/run", "file:///run", "gs://b", "s3a://b/c"])
def test_addresses(text: str) -> None:
    assert is_address(text)


@pytest.mark.parametrize(
    "text",
    [
        "runs/mine",
        "/runs/mine",
        "C:\\runs",
        "zip://x::https://b/c",
        "simplecache::s3://b",
        "reference://r",
        "a b://c",
    ],
)
def test_no_addresses(text: str) -> None:
    assert not is_address(text)


def test_what_changed_is_copied_and_what_is_needless_is_removed(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = Copy(run, AT)
    copy.update()
    assert names(store) == RUN
    (run / CHECKPOINT).unlink()
    (run / "weights/pretrain.pt").unlink()  # by nobody of ours: the copy is all that is left
    (run / "result.json").write_text("{}")
    put: list[str] = []
    monkeypatch.setattr(type(store), "put_file", lambda self, here, there: put.append(there))
    copy.update()
    assert put == []
    assert names(store) == RUN - {CHECKPOINT} | {"result.json"}


def test_what_is_needless_is_removed_by_the_next_machine_too(store: Store, run: Path) -> None:
    Copy(run, AT).update()
    (run / CHECKPOINT).unlink()
    Copy(run, AT).update()
    assert names(store) == RUN - {CHECKPOINT}


def test_a_file_that_says_that_others_are_whole_is_copied_after_them(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy, order = Copy(run, AT), list[str]()
    put, pipe = type(store).put_file, type(store).pipe_file

    def putting(self: Store, here: str, there: str) -> None:
        order.append(Path(here).name)
        (run / "stages.json").write_text('{"pretrain": {}, "finetune": "its weights are not copied yet"}')
        put(self, here, there)

    def piping(self: Store, there: str, content: bytes) -> None:
        order.append(Path(there).name)
        pipe(self, there, content)

    monkeypatch.setattr(type(store), "put_file", putting)
    monkeypatch.setattr(type(store), "pipe_file", piping)
    copy.update()
    assert order == ["overrides.json", "last.ckpt", "pretrain.pt", "stages.json"]
    assert json.loads(store.cat_file("/bucket/runs/mine/stages.json")) == {"pretrain": {}}
    monkeypatch.undo()
    copy.update()
    assert b"finetune" in store.cat_file("/bucket/runs/mine/stages.json")


def test_a_checkpoint_is_removed_after_its_stage_is_recorded_and_before_the_run_is_done(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: the stage would be trained anew. After: a run that is done does not go on, and it would stay."""
    (run / "stages.json").unlink()
    copy = Copy(run, AT)
    copy.update()
    (run / CHECKPOINT).unlink()
    (run / "stages.json").write_text("{}")
    (run / "result.json").write_text("{}")
    seen, remove = list[set[str]](), type(store).rm_file

    def removing(self: Store, there: str) -> None:
        seen.append(names(store))
        remove(self, there)

    monkeypatch.setattr(type(store), "rm_file", removing)
    copy.update()
    assert seen == [RUN]
    assert names(store) == RUN - {CHECKPOINT} | {"result.json"}


def test_a_stage_that_ends_while_the_folder_is_listed_keeps_its_checkpoint(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (run / "stages.json").unlink()
    copy = Copy(run, AT)
    copy.update()
    stamps, calls = addresses._stamps, list[int]()

    def listing(folder: Path) -> dict[str, list[int]]:
        found = stamps(folder)
        calls.append(1)
        if len(calls) == 1:  # what is gone is known, marks are not yet read
            (run / CHECKPOINT).unlink()
            (run / "stages.json").write_text("{}")
        return found

    monkeypatch.setattr(addresses, "_stamps", listing)
    copy.update()
    assert CHECKPOINT in names(store)
    copy.update()
    assert CHECKPOINT not in names(store)


def test_a_mark_that_changes_while_it_is_read_is_copied_again(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy, stamps, calls = Copy(run, AT), addresses._stamps, list[int]()

    def listing(folder: Path) -> dict[str, list[int]]:
        calls.append(1)
        if len(calls) == 2:  # marks have been read
            (run / "stages.json").write_text('{"pretrain": {}, "finetune": {}}')
        return stamps(folder)

    monkeypatch.setattr(addresses, "_stamps", listing)
    copy.update()
    assert b"finetune" not in store.cat_file("/bucket/runs/mine/stages.json")
    copy.update()
    assert b"finetune" in store.cat_file("/bucket/runs/mine/stages.json")


def test_what_has_not_begun_is_not_copied(store: Store, run: Path) -> None:
    (run / "overrides.json").rename(run / "later")
    copy = Copy(run, AT)
    copy.update()
    assert names(store) == set()


def test_a_run_is_fetched_whole(store: Store, run: Path, tmp_path: Path) -> None:
    Copy(run, AT).update()
    there = tmp_path / "elsewhere"
    fetch(AT, there)
    assert (there / "weights/pretrain.pt").read_bytes() == b"weights"
    assert json.loads((there / "overrides.json").read_text()) == {"folder": str(Path.cwd())}
    assert address_of(there) == AT
    assert {path.name for path in tmp_path.iterdir()} == {"mine", "elsewhere"}


def test_half_of_a_run_is_never_there(
    store: Store, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Copy(run, AT).update()

    def broken(self: Store, there: str, here: str) -> None:
        Path(here).write_text("begun")
        raise ConnectionError("the line is dead")

    monkeypatch.setattr(type(store), "get_file", broken)
    with pytest.raises(
        UserError, match=r"memory://bucket/runs/mine cannot be read \(ConnectionError: the line is"
    ):
        fetch(AT, tmp_path / "elsewhere")
    assert {path.name for path in tmp_path.iterdir()} == {"mine"}


def test_a_file_that_vanishes_while_it_is_fetched(
    store: Store, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Copy(run, AT).update()
    found = {"overrides.json": "1", "gone": "1"}
    monkeypatch.setattr(addresses._Store, "files", lambda self: found)
    with pytest.raises(UserError, match="changed while it was fetched: give the same command again"):
        fetch(AT, tmp_path / "elsewhere")


def test_a_damaged_run_is_not_fetched(store: Store, run: Path, tmp_path: Path) -> None:
    (run / "overrides.json").write_text("[1]")
    Copy(run, AT).update()
    with pytest.raises(UserError, match=f"{AT}/overrides.json is damaged"):
        fetch(AT, tmp_path / "elsewhere")


def test_the_cache_follows_what_is_there(
    store: Store, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    copy = Copy(run, AT)
    copy.update()
    first = fetched(AT)
    assert first.name == "mine"
    assert fetched(AT) == first
    (run / "weights/pretrain.pt").write_bytes(b"other weights")
    copy.update()
    assert (fetched(AT) / "weights/pretrain.pt").read_bytes() == b"other weights"


def test_a_store_that_says_nothing_of_changes_is_read_anew(
    store: Store, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(addresses, "_VERSIONED_BY", ())
    Copy(run, AT).update()
    assert fetched(AT) != fetched(AT)


def test_errors_of_a_run_that_was_fetched_name_its_address(
    store: Store, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Copy(run, AT).update()
    with pytest.raises(UserError, match=f"^{AT} has no schema$"), read_at(AT) as folder:
        raise UserError(f"{folder} has no schema")


def test_a_name_that_leads_out_of_the_folder_is_refused(
    store: Store, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Copy(run, AT).update()
    found = {"overrides.json": "1", "../../evil": "1"}
    monkeypatch.setattr(addresses._Store, "files", lambda self: found)
    with pytest.raises(UserError, match="leads out of this folder"):
        fetch(AT, tmp_path / "a" / "b")
    assert not (tmp_path / "evil").exists()


def test_locks_and_halves_of_a_stranger_are_not_fetched(store: Store, run: Path, tmp_path: Path) -> None:
    Copy(run, AT).update()
    for name in (".lock", "weights/.a.host.1.partial"):
        store.pipe_file(f"/bucket/runs/mine/{name}", b"theirs")
    fetch(AT, tmp_path / "elsewhere")
    found = {str(path.relative_to(tmp_path / "elsewhere")) for path in (tmp_path / "elsewhere").rglob("*.*")}
    assert found == RUN | {addresses.OWNER}


def test_too_many_files_are_not_fetched(
    store: Store, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Copy(run, AT).update()
    monkeypatch.setattr(addresses, "MOST_FILES", 3)
    with pytest.raises(UserError, match="has 4 files, more than the 3 that are fetched"):
        fetch(AT, tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("files", "said"),
    [({}, "there is nothing"), ({"other": b""}, "there is no overrides.json among its 1 files")],
    ids=["nothing", "others"],
)
def test_what_is_no_run_is_said(store: Store, tmp_path: Path, files: dict[str, bytes], said: str) -> None:
    for name, content in files.items():
        store.pipe_file(f"/bucket/runs/mine/{name}", content)
    with pytest.raises(UserError, match=said):
        fetch(AT, tmp_path / "elsewhere")


# --------------------------------------------------------------------------------------------- whose address it is


def test_two_runs_with_one_new_address_are_not_mixed(store: Store, run: Path, tmp_path: Path) -> None:
    """Before the first copy the last one that came has the address, and the other is told; later it is refused."""
    other = tmp_path / "other"
    other.mkdir()
    (other / "overrides.json").write_text('{"other": 1}')
    first, second = Copy(other, AT), Copy(run, AT)
    with pytest.raises(UserError, match="another process has gone on with this copy"):
        first.update()
    second.update()
    with pytest.raises(UserError, match=f"holds another run, or one that has gone on .* resume={AT}"):
        Copy(other, AT)


def test_a_folder_without_a_run_takes_the_one_that_is_there(store: Store, run: Path, tmp_path: Path) -> None:
    """The same command on another machine goes on where the first one was lost."""
    Copy(run, AT).update()
    other = tmp_path / "other"
    (other / ".hydra").mkdir(parents=True)
    with pytest.raises(
        UserError, match=f"Let one fetch it: memcomp-train resume={AT} hydra.run.dir={other} --cfg job"
    ):
        Copy(other, AT, fetches=False)
    Copy(other, AT)
    assert (other / "weights/pretrain.pt").read_bytes() == b"weights"


def test_a_machine_that_comes_back_leaves_the_copy_to_the_one_that_went_on(
    store: Store, run: Path, tmp_path: Path
) -> None:
    first = Copy(run, AT)
    first.update()
    fetch(AT, tmp_path / "elsewhere")
    second = Copy(tmp_path / "elsewhere", AT)
    (run / "weights/pretrain.pt").write_bytes(b"old weights")
    with pytest.raises(UserError, match="another process has gone on with this copy"):
        first.update()
    second.update()
    assert store.cat_file("/bucket/runs/mine/weights/pretrain.pt") == b"weights"
    with pytest.raises(UserError, match="holds another run, or one that has gone on"):
        Copy(run, AT)


def test_a_kill_while_the_address_is_taken_leaves_it_to_the_folder(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Copy(run, AT).update()
    written, write = list[Path](), addresses.write_json

    def killed(path: Path, content: object) -> None:
        if written:
            raise KeyboardInterrupt
        written.append(path)
        write(path, content)

    monkeypatch.setattr(addresses, "write_json", killed)
    with pytest.raises(KeyboardInterrupt):
        Copy(run, AT)
    monkeypatch.undo()
    Copy(run, AT).update()


def test_a_copy_that_broke_off_goes_on_in_its_folder(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy, put = Copy(run, AT), type(store).put_file

    def breaking(self: Store, here: str, there: str) -> None:
        if there.endswith("last.ckpt"):
            raise ConnectionError("the line is dead")
        put(self, here, there)

    monkeypatch.setattr(type(store), "put_file", breaking)
    with pytest.raises(UserError, match="cannot be written"):
        copy.update()
    monkeypatch.undo()
    Copy(run, AT).update()
    assert names(store) == RUN


def test_a_copy_that_somebody_removed_is_made_anew(store: Store, run: Path) -> None:
    Copy(run, AT).update()
    store.rm("/bucket", recursive=True)
    Copy(run, AT).update()
    assert names(store) == RUN


def test_files_of_others_are_left_alone(store: Store, run: Path) -> None:
    store.pipe_file("/bucket/theirs/precious", b"1")
    with pytest.raises(UserError, match="holds other files: choose another address"):
        Copy(run, "memory://bucket/theirs")


def test_what_a_stranger_says_of_copies_removes_nothing(tmp_path: Path, run: Path) -> None:
    shared, victim = tmp_path / "shared", tmp_path / "victim"
    victim.mkdir()
    (victim / "precious").write_text("1")
    files = {"../victim/precious": [1, 1]}
    (run / addresses.OWNER).write_text(json.dumps({"id": "a", "address": f"file://{shared}", "files": files}))
    Copy(run, f"file://{shared}").update()
    assert (victim / "precious").exists()


# -------------------------------------------------------------------------------------------- while a run goes on


def test_copies_are_made_while_something_is_done(store: Store, run: Path) -> None:
    with copying(run, AT, 0.01):
        seen = threading.Event()
        for _ in range(1000):
            if store.exists("/bucket/runs/mine/stages.json") or seen.wait(0.01):
                break
        assert store.exists("/bucket/runs/mine/stages.json")
        (run / "result.json").write_text("{}")
    assert store.exists("/bucket/runs/mine/result.json")


def test_nothing_is_copied_without_an_address(run: Path) -> None:
    with copying(run, None, 60):
        pass
    assert address_of(run) is None


def test_what_failed_is_copied_too(store: Store, run: Path) -> None:
    def failing() -> None:
        with copying(run, AT, 60):
            (run / "error.json").write_text("{}")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        failing()
    assert store.exists("/bucket/runs/mine/error.json")


def test_a_last_copy_that_fails_is_told(store: Store, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: Store, here: str, there: str) -> None:
        raise PermissionError("not yours")

    monkeypatch.setattr(type(store), "put_file", broken)
    with (
        pytest.raises(NotCopiedError, match=r"cannot be written \(PermissionError: not yours\)"),
        copying(run, AT, 60),
    ):
        pass


def test_a_store_that_does_not_answer_does_not_hold_the_run(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()
    monkeypatch.setattr(addresses, "LONGEST_WAIT_S", 0.01)
    monkeypatch.setattr(type(store), "put_file", lambda self, here, there: released.wait(60))
    with pytest.raises(NotCopiedError, match=f"{AT} does not answer"), copying(run, AT, 60):
        pass
    released.set()
    for thread in threading.enumerate():
        if thread.name.startswith("copying to "):
            thread.join()


def test_a_place_that_vanishes_is_told(store: Store, run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(self: Store, here: str, there: str) -> None:
        raise FileNotFoundError("no such bucket")

    copy = Copy(run, AT)
    monkeypatch.setattr(type(store), "put_file", missing)
    with pytest.raises(UserError, match=r"is not there any more \(no such bucket\)"):
        copy.update()


def test_a_place_that_is_not_there_is_told_before_training(
    store: Store, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(self: Store, there: str, content: bytes) -> None:
        raise FileNotFoundError("no such bucket")

    monkeypatch.setattr(type(store), "pipe_file", missing)
    with pytest.raises(UserError, match=r"copy_to = .* is not there \(no such bucket\): make it first"):
        Copy(run, AT)


def test_stores_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match=r"nowhere://run cannot be reached .*nowhere"):
        check_address("nowhere://run")
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(UserError, match="s3fs"):
        check_address("s3://bucket/run")


# ------------------------------------------------------------------------------------------------ another folder


def test_a_copy_in_another_folder_is_written_whole(
    tmp_path: Path, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill in the middle of a checkpoint leaves the one before."""
    address, place = f"file://{tmp_path}/store", tmp_path / "store" / CHECKPOINT
    copy = Copy(run, address)
    copy.update()
    (run / CHECKPOINT).write_bytes(b"a newer checkpoint")

    def half(source: str, target: str) -> None:
        Path(target).write_bytes(b"a ne")
        raise KeyboardInterrupt

    monkeypatch.setattr(addresses.shutil, "copyfile", half)
    with pytest.raises(KeyboardInterrupt):
        copy.update()
    assert place.read_bytes() == b"checkpoint"
    assert not list(place.parent.glob(".*.partial"))


def test_links_at_an_address_are_refused(tmp_path: Path, run: Path) -> None:
    address, secret = f"file://{tmp_path}/store", tmp_path / "secret"
    Copy(run, address).update()
    secret.write_text("mine")
    (tmp_path / "store/weights/link.pt").symlink_to(secret)
    with pytest.raises(UserError, match=r"weights/link.pt is a link, as no run has: remove it"):
        fetch(address, tmp_path / "elsewhere")


def test_a_link_at_an_address_is_not_written_through(tmp_path: Path, run: Path) -> None:
    address, precious = f"file://{tmp_path}/store", tmp_path / "precious"
    copy = Copy(run, address)
    copy.update()
    precious.write_text("mine")
    place = tmp_path / "store/weights/pretrain.pt"
    place.unlink()
    place.symlink_to(precious)
    (run / "weights/pretrain.pt").write_bytes(b"other")
    copy.update()
    assert precious.read_text() == "mine"
    assert place.read_bytes() == b"other"


def test_a_copy_in_the_run_folder_is_refused(run: Path) -> None:
    with pytest.raises(UserError, match="is in the run folder"):
        Copy(run, f"file://{run}{os.sep}copy")
