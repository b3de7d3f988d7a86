"""Keeps two processes out of one run folder, on disks that machines share, too.

A lock is a file that a hard link makes, which succeeds for one of all who try, on NFS as well. Who holds it
touches it every few seconds. A process that is gone from this machine is seen at once; whether one on another
machine still lives is seen by its touching, without comparing clocks.
"""

import _thread
import json
import logging
import os
import shlex
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from memcomp_lightning.errors import UserError
from memcomp_lightning.files import lives

NAME = ".lock"

BEAT_S = 10.0
"""Seconds between two touches."""

PATIENCE_S = 60.0
"""Seconds without a touch after which a process on another machine counts as ended."""

_held_here: set[Path] = set()
"""Locks that this process holds; one that it could not take away, as its folder had vanished, it holds no more."""

log = logging.getLogger(__name__)


class InUseError(UserError):
    """Another process holds a folder."""


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Hold a folder, which exists, for this process.

    Raises:
        InUseError: Another process holds it; the message says which, and what to do.
        OSError: No file can be made in it.
    """
    path, own = folder / NAME, _about_this_process()
    while not _taken(path, own):
        _free_or_raise(path)
    ended = threading.Event()
    beat = threading.Thread(target=_beat, args=(path, own, ended), daemon=True)
    beat.start()
    _held_here.add(path.absolute())
    try:
        yield
    finally:
        _held_here.discard(path.absolute())
        ended.set()
        beat.join()
        with suppress(OSError):
            if _holder(path) == own:
                path.unlink(missing_ok=True)


def _about_this_process() -> dict[str, Any]:
    pid = os.getpid()
    began = datetime.now().astimezone().isoformat(" ", "seconds")
    return {"host": socket.gethostname(), "machine": _machine(), "pid": pid, "start": _start(pid), "since": began}


def _machine() -> list[str]:
    """What tells machines and containers apart that have one name."""
    found = []
    with suppress(OSError):
        found.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
        found.append(str(Path("/proc/self/ns/pid").readlink()))
    return found


def _start(pid: int) -> str | None:
    """When a process began, as its system counts; another process may have its number later. None if not known."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        return None


def _taken(path: Path, own: dict[str, Any]) -> bool:
    """Take the lock if nobody has it."""
    mine = path.with_name(f"{NAME}.{own['host']}.{own['pid']}")
    try:
        mine.write_text(json.dumps(own))
        try:
            path.hardlink_to(mine)
        except FileExistsError:
            # The answer that the link was made may be lost on the way from a server.
            return mine.stat().st_nlink == 2
        except OSError:  # a disk without links
            return _created(path, own)
        return True
    finally:
        mine.unlink(missing_ok=True)


def _created(path: Path, own: dict[str, Any]) -> bool:
    try:
        with path.open("x") as file:
            file.write(json.dumps(own))
    except FileExistsError:
        return False
    return True


def _holder(path: Path) -> dict[str, Any] | None:
    """Who holds the lock; None if nobody does, no names if the file is damaged."""
    try:
        found = json.loads(path.read_text())
    except FileNotFoundError:
        return None
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _free_or_raise(path: Path) -> None:
    """Return once the lock is free to be taken; raise an InUseError if its holder lives."""
    holder = _holder(path)
    if holder is None:
        return
    here = holder.get("host") == socket.gethostname() and holder.get("machine") == _machine()
    if _lives_here(path, holder) if here else _touched(path, holder):
        raise InUseError(_refusal(path, holder))
    if _holder(path) != holder:
        return
    log.warning("%s was left by a process that has ended: %s", path, _named(holder))
    _take_away(path, holder)


def _lives_here(path: Path, holder: dict[str, Any]) -> bool:
    pid = holder.get("pid")
    if not isinstance(pid, int):
        return False
    if pid == os.getpid() and path.absolute() not in _held_here:
        return False
    return lives(pid) and _start(pid) == holder.get("start")


def _touched(path: Path, holder: dict[str, Any]) -> bool:
    """Watch whether the holder touches the lock; False if it does not for as long as it would take."""
    log.warning("waiting up to %d s for a sign of life of %s, which holds %s", PATIENCE_S, _named(holder), path)
    began, first = time.monotonic(), _when(path)
    while time.monotonic() - began < PATIENCE_S:
        time.sleep(min(1.0, PATIENCE_S / 10))
        now = _when(path)
        if now is None or _holder(path) != holder:
            return False
        if now != first:
            return True
    return False


def _when(path: Path) -> int | None:
    """When the lock was touched; opened for it, as NFS asks its server then."""
    try:
        with path.open("rb") as file:
            return os.fstat(file.fileno()).st_mtime_ns
    except FileNotFoundError:
        return None


def _take_away(path: Path, holder: dict[str, Any]) -> None:
    """Remove the lock of a process that has ended, unless another one has been quicker."""
    aside = path.with_name(f"{NAME}.old.{socket.gethostname()}.{os.getpid()}")
    with suppress(FileNotFoundError):
        path.rename(aside)
        if _holder(aside) != holder:  # that of the quicker one
            with suppress(OSError):
                path.hardlink_to(aside)
        aside.unlink()


def _beat(path: Path, own: dict[str, Any], ended: threading.Event) -> None:
    while not ended.wait(BEAT_S):
        with suppress(OSError):
            if _holder(path) not in (own, None):
                log.error("%s was taken by another process: this one ends.", path.parent)
                _interrupt()
                return
            os.utime(path)


def _interrupt() -> None:
    """As Ctrl-C does; ``interrupt_main`` alone would let a main thread that waits go on waiting."""
    main = threading.main_thread().ident
    if main is None or not hasattr(signal, "pthread_kill"):
        _thread.interrupt_main()
    else:
        signal.pthread_kill(main, signal.SIGINT)


def _named(holder: dict[str, Any]) -> str:
    return f"process {holder.get('pid')} on {holder.get('host')}, since {holder.get('since')}"


def _refusal(path: Path, holder: dict[str, Any]) -> str:
    end = f"kill {holder.get('pid')}"
    if holder.get("host") != socket.gethostname():
        end = f"ssh {holder.get('host')} {end}"
    remedy = f"Wait for it, end it with {end}, or choose another folder with hydra.run.dir=PATH"
    return (
        f"run folder {path.parent} is in use by {_named(holder)}: two would mix their results. {remedy}. "
        f"If no process uses the folder, type {shlex.join(['rm', str(path)])}"
    )
