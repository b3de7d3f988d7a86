"""Copies of run folders at addresses."""

import json
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import fsspec
import pytest

from memcomp_lightning.errors import UserError
from memcomp_lightning.runs import addresses
from memcomp_lightning.runs.addresses import check_address, copied, fetch, fetched, is_address, update

AT = "memory://bucket/runs/mine"


@pytest.fixture
def store() -> Iterator[fsspec.AbstractFileSystem]:
    memory = fsspec.filesystem("memory")
    yield memory
    if memory.exists("/bucket"):
        memory.rm("/bucket", recursive=True)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "mine"
    (folder / "weights").mkdir(parents=True)
    (folder / "overrides.json").write_text("{}")
    (folder / "weights/pretrain.pt").write_bytes(b"weights")
    (folder / "stages.json").write_text('{"pretrain": {}}')
    (folder / ".lock").write_text("held")
    (folder / ".weights.host.1.partial").write_text("half")
    return folder


def names(store: fsspec.AbstractFileSystem) -> set[str]:
    return {path.removeprefix("/bucket/runs/mine/") for path in store.find("/bucket/runs/mine")}


@pytest.mark.parametrize("text", ["s3://bucket/run", "file:///run", "gs://b", "s3a://b/c"])
def test_addresses(text: str) -> None:
    assert is_address(text)


@pytest.mark.parametrize(
    "text", ["runs/mine", "/runs/mine", "C:\\runs", "run://", "simplecache::s3://b", "a b://c"]
)
def test_no_addresses(text: str) -> None:
    assert is_address(text) == (text == "run://")


def test_what_changed_is_copied_and_what_is_gone_is_removed(
    store: fsspec.AbstractFileSystem, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update(run, AT)
    assert names(store) == {"overrides.json", "weights/pretrain.pt", "stages.json"}
    (run / "weights/pretrain.pt").unlink()
    (run / "result.json").write_text("{}")
    put = []
    monkeypatch.setattr(type(store), "put_file", lambda self, here, there: put.append(there))
    update(run, AT)
    assert put == []
    assert names(store) == {"overrides.json", "stages.json", "result.json"}


def test_a_file_that_says_that_others_are_whole_is_copied_after_them(
    store: fsspec.AbstractFileSystem, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order, put, pipe = [], type(store).put_file, type(store).pipe_file

    def putting(self: fsspec.AbstractFileSystem, here: str, there: str) -> None:
        order.append(Path(here).name)
        (run / "stages.json").write_text('{"pretrain": {}, "finetune": "its weights are not copied yet"}')
        put(self, here, there)

    def piping(self: fsspec.AbstractFileSystem, there: str, content: bytes) -> None:
        order.append(Path(there).name)
        pipe(self, there, content)

    monkeypatch.setattr(type(store), "put_file", putting)
    monkeypatch.setattr(type(store), "pipe_file", piping)
    update(run, AT)
    assert order == ["overrides.json", "pretrain.pt", "stages.json"]
    assert json.loads(store.cat_file("/bucket/runs/mine/stages.json")) == {"pretrain": {}}
    monkeypatch.undo()
    update(run, AT)
    assert b"finetune" in store.cat_file("/bucket/runs/mine/stages.json")


def test_a_file_that_is_gone_is_removed_before_the_run_is_said_to_be_done(
    store: fsspec.AbstractFileSystem, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a machine that is lost in between leaves a checkpoint for ever: a run that is done does not go on."""
    update(run, AT)
    (run / "weights/pretrain.pt").unlink()
    (run / "result.json").write_text("{}")
    seen, remove = list[set[str]](), type(store).rm_file

    def removing(self: fsspec.AbstractFileSystem, there: str) -> None:
        seen.append(names(store))
        remove(self, there)

    monkeypatch.setattr(type(store), "rm_file", removing)
    update(run, AT)
    assert seen == [{"overrides.json", "weights/pretrain.pt", "stages.json"}]


def test_what_has_not_begun_is_not_copied(store: fsspec.AbstractFileSystem, run: Path) -> None:
    (run / "overrides.json").rename(run / "later")
    update(run, AT)
    assert names(store) == set()
    update(run.with_name("vanished"), AT)
    assert names(store) == set()


def test_a_damaged_run_is_not_fetched(store: fsspec.AbstractFileSystem, run: Path, tmp_path: Path) -> None:
    (run / "overrides.json").write_text("[1]")
    update(run, AT)
    with pytest.raises(UserError, match=f"{AT}/overrides.json is damaged"):
        fetch(AT, tmp_path / "elsewhere")


def test_a_run_is_fetched_whole(store: fsspec.AbstractFileSystem, run: Path, tmp_path: Path) -> None:
    update(run, AT)
    there = tmp_path / "elsewhere"
    fetch(AT, there)
    assert (there / "weights/pretrain.pt").read_bytes() == b"weights"
    assert json.loads((there / "overrides.json").read_text()) == {"folder": str(Path.cwd())}
    store.rm_file("/bucket/runs/mine/weights/pretrain.pt")
    update(there, AT)  # its copies are known: nothing is written that has not changed
    assert names(store) == {"overrides.json", "stages.json"}


def test_nothing_is_fetched_over_a_folder(store: fsspec.AbstractFileSystem, run: Path) -> None:
    update(run, AT)
    with pytest.raises(FileExistsError):
        fetch(AT, run)


def test_half_of_a_run_is_never_there(
    store: fsspec.AbstractFileSystem, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update(run, AT)

    def broken(self: fsspec.AbstractFileSystem, there: str, here: str) -> None:
        Path(here).write_text("begun")
        raise ConnectionError("the line is dead")

    monkeypatch.setattr(type(store), "get_file", broken)
    with pytest.raises(
        UserError, match=r"memory://bucket/runs/mine cannot be read \(ConnectionError: the line is"
    ):
        fetch(AT, tmp_path / "elsewhere")
    assert {path.name for path in tmp_path.iterdir()} == {"mine"}


def test_the_cache_follows_what_is_there(
    store: fsspec.AbstractFileSystem, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    update(run, AT)
    first = fetched(AT)
    assert first.name == "mine"
    assert fetched(AT) == first
    (run / "weights/pretrain.pt").write_bytes(b"other weights")
    update(run, AT)
    assert (fetched(AT) / "weights/pretrain.pt").read_bytes() == b"other weights"


def test_a_name_that_leads_out_of_the_folder_is_refused(
    store: fsspec.AbstractFileSystem, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update(run, AT)
    there = {"overrides.json": "1", "../../evil": "1"}
    monkeypatch.setattr(addresses, "_files", lambda address: there)
    with pytest.raises(UserError, match="leads out of this folder"):
        fetch(AT, tmp_path / "a" / "b")
    assert not (tmp_path / "evil").exists()


def test_too_many_files_are_not_fetched(
    store: fsspec.AbstractFileSystem, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    update(run, AT)
    monkeypatch.setattr(addresses, "MOST_FILES", 2)
    with pytest.raises(UserError, match="has 3 files, more than the 2 that are fetched"):
        fetch(AT, tmp_path / "elsewhere")


@pytest.mark.parametrize(
    ("files", "said"),
    [({}, "there is nothing"), ({"other": b""}, "there is no overrides.json among its 1 files")],
    ids=["nothing", "others"],
)
def test_what_is_no_run_is_said(
    store: fsspec.AbstractFileSystem, tmp_path: Path, files: dict[str, bytes], said: str
) -> None:
    for name, content in files.items():
        store.pipe_file(f"/bucket/runs/mine/{name}", content)
    with pytest.raises(UserError, match=said):
        fetch(AT, tmp_path / "elsewhere")


def test_an_address_with_something_else_is_left_alone(
    store: fsspec.AbstractFileSystem, run: Path, tmp_path: Path
) -> None:
    update(run, AT)
    other = tmp_path / "other"
    with (
        pytest.raises(UserError, match=f"holds a run already. Go on with it by memcomp-train resume={AT}"),
        copied(other, AT, 60),
    ):
        raise AssertionError
    with copied(run, AT, 60):  # its own
        pass
    store.pipe_file("/bucket/theirs/precious", b"1")
    with pytest.raises(UserError, match="holds other files"), copied(other, "memory://bucket/theirs", 60):
        raise AssertionError


def test_copies_are_made_while_something_is_done(store: fsspec.AbstractFileSystem, run: Path) -> None:
    with copied(run, AT, 0.01):
        seen = threading.Event()
        for _ in range(1000):
            if store.exists("/bucket/runs/mine/stages.json") or seen.wait(0.01):
                break
        assert store.exists("/bucket/runs/mine/stages.json")
        (run / "result.json").write_text("{}")
    assert store.exists("/bucket/runs/mine/result.json")


def test_what_failed_is_copied_too(store: fsspec.AbstractFileSystem, run: Path) -> None:
    def failing() -> None:
        with copied(run, AT, 60):
            (run / "error.json").write_text("{}")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        failing()
    assert store.exists("/bucket/runs/mine/error.json")


def test_a_last_copy_that_fails_names_the_command(
    store: fsspec.AbstractFileSystem, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: fsspec.AbstractFileSystem, here: str, there: str) -> None:
        raise PermissionError("not yours")

    monkeypatch.setattr(type(store), "put_file", broken)
    told = f"cannot be written \\(PermissionError: not yours\\).*memcomp-train resume={run} copy_to={AT}"
    with pytest.raises(UserError, match=told), copied(run, AT, 60):
        pass


def test_stores_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match=r"nowhere://run cannot be reached .*nowhere"):
        check_address("nowhere://run")
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(UserError, match="s3fs"):
        check_address("s3://bucket/run")
