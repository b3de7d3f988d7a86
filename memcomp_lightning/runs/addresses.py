"""Run folders at addresses, as ``s3://bucket/run``: copies of folders in which the work is done.

A run renames and links files, which object stores cannot do. So it trains in a folder of a file system; what
changes there is copied to an address, and a run at an address is fetched before it is used. Stores are fsspec's.
"""

import hashlib
import logging
import os
import re
import shutil
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from memcomp_lightning.errors import UserError
from memcomp_lightning.files import inside, read_json, write_json
from memcomp_lightning.runs import lock

INDEX = ".copied.json"
"""Says which files of a folder are at its address, and how they were."""

MOST_FILES = 100_000
"""Files that are fetched from one address: more than any run has."""

BEGUN = "overrides.json"
"""Says that a folder is a run: it is the first file that is copied."""

_STAGES, _RESULT = "stages.json", "result.json"
"""They say that other files are whole: they are read before these are listed, and copied after them."""

_VERSIONED_BY = (
    "size",
    "ETag",
    "etag",
    "md5Hash",
    "generation",
    "mtime",
    "LastModified",
    "last_modified",
    "created",
)
"""What stores tell of a file that changes when it does; each has some of them."""

log = logging.getLogger(__name__)


def is_address(text: str) -> bool:
    """Whether a text is an address, and no path."""
    return re.match(r"\w[\w+.-]*://", text) is not None


def name_of(address: str) -> str:
    """The last part of an address: the name of a run."""
    return address.rstrip("/").rpartition("/")[2]


def check_address(address: str) -> None:
    """Raise a UserError if there is no such kind of store, or its library is not installed."""
    _store(address)


def cache() -> Path:
    """Where runs lie that were fetched to be read."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "memcomp_lightning" / "runs"


# ------------------------------------------------------------------------------------------------ from an address


def fetch(address: str, folder: Path) -> None:
    """Fetch a run into a folder, which must not be there; it appears when it is whole.

    Relative paths in its settings are meant from the present folder from now on: that in which they were typed may
    be on another machine.

    Raises:
        UserError: There is no run, or it cannot be read.
    """
    _fetch(address, folder, _run_at(address), typed_in=Path.cwd())


def fetched(address: str) -> Path:
    """A copy of a run to be read, in the user's cache; it is fetched where it is not there as it is now.

    Relative paths in its settings are meant from the folder in which it is used.

    Raises:
        UserError: There is no run, or it cannot be read.
    """
    there = _run_at(address)
    version = hashlib.sha256(repr([address, sorted(there.items())]).encode()).hexdigest()[:16]
    folder = cache() / version / name_of(address)
    if not folder.is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        try:
            _fetch(address, folder, there, typed_in=None)
        except OSError:
            if not folder.is_dir():  # else another process was quicker
                raise
    return folder


def _run_at(address: str) -> dict[str, str]:
    there = _files(address)
    if BEGUN not in there:
        has = f"no overrides.json among its {len(there)} files" if there else "nothing"
        raise UserError(f"{address}: there is {has}. Name the address that a run of memcomp-train was copied to.")
    if len(there) > MOST_FILES:
        raise UserError(f"{address} has {len(there)} files, more than the {MOST_FILES} that are fetched.")
    return there


def _fetch(address: str, folder: Path, there: Mapping[str, str], *, typed_in: Path | None) -> None:
    if folder.exists():
        raise FileExistsError(f"{folder} is there already")
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        store, root = _store(address)
        for name in there:
            path = inside(partial, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                with _telling(address, "read"):
                    store.get_file(f"{root}/{name}", str(path))
            except FileNotFoundError as error:
                raise UserError(f"{address} changed while it was fetched: give the same command again.") from error
        _keep_index(partial, address, _stamps(partial))
        try:
            begun = dict(read_json(partial / BEGUN))
        except (ValueError, TypeError) as error:
            raise UserError(f"{address}/{BEGUN} is damaged: restore it.") from error
        write_json(partial / BEGUN, {**begun, "folder": None if typed_in is None else str(typed_in)})
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


# -------------------------------------------------------------------------------------------------- to an address


@contextmanager
def copied(folder: Path, address: str | None, every_s: float) -> Iterator[None]:
    """Copy a folder, while something is done in it, every so many seconds, and at the end, however it ends.

    A copy that fails while the work goes on is tried again; None copies nothing.

    Raises:
        UserError: The address holds another run; the work was done and the last copy failed.
    """
    if address is None:
        yield
        return
    _check_free(folder, address)
    ended = threading.Event()
    copier = threading.Thread(target=_copy_until, args=(folder, address, every_s, ended), daemon=True)
    copier.start()
    try:
        yield
    except BaseException:
        _end(copier, ended)
        _tried(folder, address)
        raise
    _end(copier, ended)
    try:
        update(folder, address)
    except UserError as error:
        again = f"memcomp-train resume={folder} copy_to={address}"
        raise UserError(f"{error} The run is whole in {folder}. Copy it with: {again}") from error


def update(folder: Path, address: str) -> None:
    """Copy what has changed in a folder since it was last copied, and remove from the address what is gone.

    Raises:
        UserError: The store cannot be written.
    """
    if not (folder / BEGUN).is_file():  # nothing that could go on
        return
    marks = {name: _read(folder / name) for name in (_STAGES, _RESULT) if (folder / name).is_file()}
    now = {name: stamp for name, stamp in _stamps(folder).items() if name not in (_STAGES, _RESULT)}
    before = _copied_before(folder, address)
    done = {name: stamp for name, stamp in before.items() if name in now or name in marks}
    store, root = _store(address)

    def mark(name: str) -> None:
        if name in marks and marks[name].stamp != before.get(name):
            store.pipe_file(f"{root}/{name}", marks[name].content)
            done[name] = marks[name].stamp

    with _telling(address, "written"):
        for name in sorted(now, key=lambda name: name != BEGUN):
            if now[name] != before.get(name):
                with suppress(FileNotFoundError):  # removed meanwhile: the next time sees it
                    store.makedirs(f"{root}/{name}".rpartition("/")[0], exist_ok=True)
                    store.put_file(str(folder / name), f"{root}/{name}")
                    done[name] = now[name]
        mark(_STAGES)
        for name in before.keys() - done.keys():
            with suppress(FileNotFoundError):
                store.rm_file(f"{root}/{name}")
        mark(_RESULT)
    if done != before:
        _keep_index(folder, address, done)


class _Mark(NamedTuple):
    """A file that says that others are whole, as it is copied once they are."""

    stamp: list[int]
    content: bytes


def _read(path: Path) -> _Mark:
    stat = path.stat()
    return _Mark([stat.st_size, stat.st_mtime_ns], path.read_bytes())


def _check_free(folder: Path, address: str) -> None:
    """Raise a UserError if an address holds something that is not this run."""
    there = _files(address)
    if not there or _copied_before(folder, address):
        return
    if BEGUN not in there:
        raise UserError(f"copy_to = {address} holds other files: choose another address.")
    raise UserError(
        f"copy_to = {address} holds a run already. Go on with it by memcomp-train resume={address}, or choose "
        "another address."
    )


def _copy_until(folder: Path, address: str, every_s: float, ended: threading.Event) -> None:
    while not ended.wait(every_s):
        _tried(folder, address)


def _tried(folder: Path, address: str) -> None:
    try:
        update(folder, address)
    except (UserError, OSError) as error:
        log.warning("Not copied now: %s", error)


def _end(copier: threading.Thread, ended: threading.Event) -> None:
    ended.set()
    copier.join()


# ---------------------------------------------------------------------------------------------------------- both


def _stamps(folder: Path) -> dict[str, list[int]]:
    """Size in bytes and time of the last change in nanoseconds, of each file of a folder that is to be copied."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.name in (lock.NAME, INDEX) or path.name.endswith(".partial") or path.is_symlink():
            continue
        with suppress(FileNotFoundError):
            stat = path.stat()
            if path.is_file():
                found[path.relative_to(folder).as_posix()] = [stat.st_size, stat.st_mtime_ns]
    return found


def _copied_before(folder: Path, address: str) -> dict[str, list[int]]:
    """What :func:`update` left of an address."""
    try:
        index = read_json(folder / INDEX)
        return dict(index["files"]) if index["address"] == address else {}
    except (OSError, ValueError, LookupError, TypeError):
        return {}


def _keep_index(folder: Path, address: str, files: Mapping[str, list[int]]) -> None:
    write_json(folder / INDEX, {"address": address, "files": dict(files)})


def _files(address: str) -> dict[str, str]:
    """What tells a file at an address from another version of it, by its name."""
    store, root = _store(address)
    with _telling(address, "read"):
        store.invalidate_cache()
        try:
            found = store.find(root, detail=True)
        except FileNotFoundError:
            return {}
    names = {path[len(root) :].lstrip("/"): info for path, info in found.items() if path.startswith(root)}
    return {name: repr([info.get(key) for key in _VERSIONED_BY]) for name, info in names.items() if name}


def _store(address: str) -> tuple[Any, str]:
    """The store of an address, and where in it that is."""
    import fsspec  # which few runs need

    with _telling(address, "reached"):
        store, root = fsspec.core.url_to_fs(address)
    return store, str(root).rstrip("/")


@contextmanager
def _telling(address: str, what: str) -> Iterator[None]:
    """Tell in a line what a store says; each has errors of its own."""
    try:
        yield
    except FileNotFoundError:
        raise
    except Exception as error:
        said = " ".join(str(error).split())[:200]
        raise UserError(f"{address} cannot be {what} ({type(error).__name__}: {said}).") from error
