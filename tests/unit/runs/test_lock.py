"""A run folder has one process at a time, on this machine and on others."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from memcomp_lightning.errors import UserError
from memcomp_lightning.runs import lock
from memcomp_lightning.runs.lock import NAME, InUseError, held

HOLD = """
import sys, time
from pathlib import Path
from memcomp_lightning.runs.lock import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""
COUNT = """
import sys
from pathlib import Path
from memcomp_lightning.runs.lock import InUseError, held
folder, n = Path(sys.argv[1]), 0
while n < 50:
    try:
        with held(folder):
            number = int((folder / "count").read_text())
            (folder / "count").write_text(str(number + 1))
            n += 1
    except InUseError:
        pass
"""


@pytest.fixture
def holder(tmp_path: Path) -> "Any":
    process = subprocess.Popen([sys.executable, "-c", HOLD, tmp_path], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def written(folder: Path, **changed: object) -> None:
    """The lock of this process with something else in it."""
    (folder / NAME).write_text(json.dumps({**lock._about_this_process(), **changed}))


def test_a_folder_is_held_and_given_back(tmp_path: Path) -> None:
    with held(tmp_path):
        assert json.loads((tmp_path / NAME).read_text())["pid"] == os.getpid()
        assert [path.name for path in tmp_path.iterdir()] == [NAME]
    assert list(tmp_path.iterdir()) == []


def test_who_holds_it_and_what_to_type_is_said(tmp_path: Path, holder: "subprocess.Popen[str]") -> None:
    with pytest.raises(InUseError) as refusal, held(tmp_path):
        pass
    said = str(refusal.value)
    assert f"is in use by process {holder.pid} on {os.uname().nodename}, since 2" in said
    assert f"kill {holder.pid}, or choose another folder with hydra.run.dir=PATH" in said
    assert said.endswith(f"type rm {tmp_path / NAME}")
    assert issubclass(InUseError, UserError)


def test_what_a_killed_process_left_is_taken(tmp_path: Path, holder: "subprocess.Popen[str]") -> None:
    holder.kill()
    holder.wait()
    assert (tmp_path / NAME).exists()
    with held(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="when a process began is not known")
def test_another_process_with_the_number_of_a_dead_one_holds_nothing(tmp_path: Path) -> None:
    written(tmp_path, start="1")
    with held(tmp_path):
        pass


@pytest.mark.parametrize("content", ["", "[]", '{"host"', "null"])
def test_a_damaged_lock_counts_as_one_of_another_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: str
) -> None:
    monkeypatch.setattr(lock, "PATIENCE_S", 0.1)
    (tmp_path / NAME).write_text(content)
    with held(tmp_path):
        pass


@pytest.mark.parametrize("other", [{"host": "moon"}, {"machine": ["another container"]}], ids=str)
def test_a_process_elsewhere_lives_as_long_as_it_touches_its_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: dict[str, object]
) -> None:
    monkeypatch.setattr(lock, "PATIENCE_S", 2.0)
    written(tmp_path, pid=2**22 + 1, **other)
    beating = True

    def beat() -> None:
        while beating:
            time.sleep(0.05)
            os.utime(tmp_path / NAME)

    thread = Thread(target=beat)
    thread.start()
    try:
        with pytest.raises(InUseError, match="is in use by process 4194305 on"), held(tmp_path):
            pass
    finally:
        beating = False
        thread.join()
    with held(tmp_path):
        pass


def test_a_lock_is_touched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "BEAT_S", 0.01)
    with held(tmp_path):
        os.utime(tmp_path / NAME, (0, 0))
        until = time.monotonic() + 60
        while (tmp_path / NAME).stat().st_mtime == 0 and time.monotonic() < until:
            time.sleep(0.01)
        assert (tmp_path / NAME).stat().st_mtime > 0


def test_a_process_whose_lock_was_taken_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lock, "BEAT_S", 0.01)
    with pytest.raises(KeyboardInterrupt), held(tmp_path):  # noqa: PT012
        written(tmp_path, host="moon")
        time.sleep(60)
    assert (tmp_path / NAME).exists(), "it is the other's"


def no_links(*_: object) -> None:
    raise PermissionError(1, "Operation not permitted")


def lost_answer(path: Path, target: Path) -> None:
    os.link(target, path)
    raise FileExistsError


@pytest.mark.parametrize("link", [no_links, lost_answer])
def test_disks_without_links_and_answers_that_are_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, link: Callable[..., None]
) -> None:
    monkeypatch.setattr(Path, "hardlink_to", link)
    with held(tmp_path):
        with pytest.raises(InUseError), held(tmp_path):
            pass
        assert [path.name for path in tmp_path.iterdir()] == [NAME]
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_raises(tmp_path: Path) -> None:
    with pytest.raises(OSError), held(tmp_path / "missing"):  # noqa: PT011
        pass


def test_one_at_a_time(tmp_path: Path) -> None:
    (tmp_path / "count").write_text("0")
    processes = [subprocess.Popen([sys.executable, "-c", COUNT, tmp_path]) for _ in range(3)]
    assert [process.wait(300) for process in processes] == [0, 0, 0]
    assert (tmp_path / "count").read_text() == "150"
