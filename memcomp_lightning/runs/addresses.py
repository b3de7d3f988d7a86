"""Run folders at addresses, as ``s3://bucket/run``: copies of folders in which the work is done.

A run renames and links files, which object stores cannot do. So it trains in a folder of a file system; what
changes there is copied to an address, and a run at an address is fetched before it is used. Stores are fsspec's.
"""

import hashlib
import logging
import os
import re
import shutil
import tempfile
import threading
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from memcomp_lightning.errors import UserError
from memcomp_lightning.files import inside, read_json, write_json, written_whole
from memcomp_lightning.runs import lock

BEGUN = "overrides.json"
"""Says that a folder is a run: it is the first file that is copied, and the last one that is put in its place."""

OWNER = ".copied.json"
"""In a folder and at its address: who copies there. The folder's says the address, too."""

MOST_FILES = 100_000
"""Files that are fetched from one address: more than any run has."""

LONGEST_WAIT_S = 600.0
"""Seconds that the end of a run waits for the last copy."""

_STAGES, _RESULT = "stages.json", "result.json"
"""Each says that others are whole. Its content is read first, then the folder is listed; it is copied last."""

_NEEDLESS = re.compile(r"(.*/)?(checkpoints/.*|error\.json)")
"""Files that a run removes when it needs them no longer. What else vanishes from a folder stays in its copy."""

_VERSIONED_BY = ("ETag", "etag", "md5Hash", "generation", "mtime", "LastModified", "last_modified", "created")
"""What stores tell of a file that changes when it does; each has some of them."""

_WITH_FOLDERS = {"file", "local", "memory", "sftp", "ssh", "smb", "ftp", "hdfs", "arrow_hdfs", "webdav"}
"""Stores in which a folder must be there before a file is put into it."""

log = logging.getLogger(__name__)


class NotCopiedError(UserError):
    """The work was done, and not copied."""


def is_address(text: str) -> bool:
    """Whether a text is the address of a store, and no path."""
    scheme = re.match(r"(\w[\w+.-]*)://", text)
    return scheme is not None and "::" not in text and scheme[1] != "reference"


def name_of(address: str) -> str:
    """The last part of an address: the name of a run."""
    return address.rstrip("/").rpartition("/")[2]


def check_address(address: str) -> None:
    """Raise a UserError if there is no such kind of store, or its library is not installed."""
    _Store(address)


def address_of(folder: Path) -> str | None:
    """Where a folder was copied to, or fetched from; None if it was not."""
    return _owner_of(folder).get("address")


# ------------------------------------------------------------------------------------------------ from an address


def fetch(address: str, folder: Path) -> None:
    """Fetch a run into a folder that holds none; it is a run when all of it is there.

    Relative paths in its settings are meant from the present folder from now on: that in which they were typed may
    be on another machine.

    Raises:
        UserError: There is no run, or it cannot be read.
    """
    store = _Store(address)
    _fetch(store, _run_at(store), folder, typed_in=str(Path.cwd()))


def fetched(address: str) -> Path:
    """A copy of a run to be read, in the user's cache; it is fetched where it is not there as it is now.

    Relative paths in its settings are meant from the folder in which it is used.

    Raises:
        UserError: There is no run, or it cannot be read.
    """
    store = _Store(address)
    there = _run_at(store)
    version = hashlib.sha256(repr([address, sorted(there.items())]).encode()).hexdigest()[:16]
    folder = cache() / version / name_of(address)
    if not (folder / BEGUN).is_file():
        _fetch(store, there, folder, typed_in=None)
    return folder


@contextmanager
def read_at(path: str) -> Iterator[Path]:
    """The folder to read a run in: the path itself, or a copy of what is at an address, which errors name then."""
    if not is_address(path):
        yield Path(path)
        return
    folder = fetched(path)
    try:
        yield folder
    except UserError as error:
        raise UserError(str(error).replace(str(folder), path)) from error


def cache() -> Path:
    """Where runs lie that were fetched to be read."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "memcomp_lightning" / "runs"


def _run_at(store: "_Store") -> dict[str, str]:
    """The files of a run, and what tells them from other versions."""
    there = store.files()
    if BEGUN not in there:
        has = f"no overrides.json among its {len(there)} files" if there else "nothing"
        raise UserError(
            f"{store.address}: there is {has}. Name the address that a run of memcomp-train was copied to."
        )
    if len(there) > MOST_FILES:
        raise UserError(f"{store.address} has {len(there)} files, more than the {MOST_FILES} that are fetched.")
    return there


def _fetch(store: "_Store", there: Mapping[str, str], folder: Path, *, typed_in: str | None) -> None:
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        for name in there:
            path = inside(partial, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            store.get(name, path)
        try:
            begun = dict(read_json(partial / BEGUN))
        except (ValueError, TypeError) as error:
            raise UserError(f"{store.address}/{BEGUN} is damaged: restore it.") from error
        write_json(partial / BEGUN, {**begun, "folder": typed_in})
        write_json(partial / OWNER, {"id": store.owner(), "address": store.address})
        for path in sorted(partial.rglob("*"), key=lambda path: path.name == BEGUN):
            if path.is_file():
                place = folder / path.relative_to(partial)
                place.parent.mkdir(parents=True, exist_ok=True)
                path.replace(place)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


# -------------------------------------------------------------------------------------------------- to an address


@contextmanager
def copying(folder: Path, address: str | None, every_s: float, *, fetches: bool = True) -> Iterator[None]:
    """Copy a folder, while something is done in it, every so many seconds, and at the end, however it ends.

    A run that is at the address already is fetched first, if the folder holds none. A copy that fails while the
    work goes on is tried again. None copies nothing; with ``fetches=False`` a run that must be fetched is refused.

    Raises:
        UserError: The address holds another run, or cannot be written.
        NotCopiedError: The last copy failed, and nothing else did.
    """
    if address is None:
        yield
        return
    copy = Copy(folder, address, fetches=fetches)
    ended, failed = threading.Event(), list[Exception]()
    work = (copy, every_s, ended, failed)
    copier = threading.Thread(target=_copy_until, name=f"copying to {address}", args=work, daemon=True)
    copier.start()
    try:
        yield
    finally:
        ended.set()
        copier.join(LONGEST_WAIT_S)
    if failed or copier.is_alive():
        raise NotCopiedError(str(failed[-1]) if failed else f"{address} does not answer.")


class Copy:
    """The copy of a folder at an address, to which this process writes from now on, and no other.

    Raises:
        UserError: The address holds another run, or cannot be written.
    """

    def __init__(self, folder: Path, address: str, *, fetches: bool = True) -> None:
        self._folder, self._store = folder, _Store(address)
        self._store.require_outside(folder)
        self._done = dict[str, list[int]]()
        there, own, theirs = self._store.files(), _owner_of(folder), self._store.owner()
        if there and (theirs is None or theirs not in (own.get("id"), own.get("next"))):
            if (folder / BEGUN).is_file() or BEGUN not in there:
                raise UserError(self._occupied(BEGUN in there))
            if not fetches:
                raise UserError(
                    f"copy_to = {address} holds this run, {folder} does not, and several processes would wait for "
                    f"it. Let one fetch it: memcomp-train resume={address} hydra.run.dir={folder} --cfg job"
                )
            fetch(address, folder)
            self._done = _stamps(folder)
        self._needless = {name for name in there if _NEEDLESS.fullmatch(name)}
        self._id = uuid.uuid4().hex
        # Both are known in between: a kill leaves the folder the owner.
        write_json(folder / OWNER, {"id": theirs, "next": self._id, "address": address})
        try:
            self._store.put(OWNER, f'{{"id": "{self._id}"}}\n'.encode())
        except FileNotFoundError as error:
            raise UserError(f"copy_to = {address} is not there ({error}): make it first.") from error
        write_json(folder / OWNER, {"id": self._id, "address": address})

    def _occupied(self, by_a_run: bool) -> str:
        address = self._store.address
        if not by_a_run:
            return f"copy_to = {address} holds other files: choose another address."
        return (
            f"copy_to = {address} holds another run, or one that has gone on in another folder. Go on with it by "
            f"resume={address}, or choose another address."
        )

    def update(self) -> None:
        """Copy what has changed since it was last copied, and remove what the run no longer needs.

        Raises:
            UserError: Another process has gone on with the copy, or the store cannot be written.
        """
        if not (self._folder / BEGUN).is_file():  # nothing that could go on
            return
        if self._store.owner() != self._id:
            raise UserError(
                f"{self._store.address}: another process has gone on with this copy; it is left alone."
            )
        before = _stamps(self._folder)
        marks = {name: (self._folder / name).read_bytes() for name in (_STAGES, _RESULT) if name in before}
        now = {name: stamp for name, stamp in _stamps(self._folder).items() if name not in (_STAGES, _RESULT)}
        for name in sorted(now, key=lambda name: name != BEGUN):
            self._copy(name, self._folder / name, now[name])
        if _STAGES in marks:
            self._copy(_STAGES, marks[_STAGES], before[_STAGES])
        for needless in self._needless - before.keys():
            self._store.remove(needless)
            self._needless.remove(needless)
            self._done.pop(needless, None)
        if _RESULT in marks:
            self._copy(_RESULT, marks[_RESULT], before[_RESULT])

    def _copy(self, name: str, content: Path | bytes, stamp: list[int]) -> None:
        """Copy a file that has changed; one that was removed meanwhile is seen the next time."""
        if self._done.get(name) == stamp:
            return
        try:
            self._store.put(name, content)
        except FileNotFoundError as error:
            if isinstance(content, bytes) or content.exists():
                raise UserError(f"{self._store.address} is not there any more ({error}).") from error
            return
        self._done[name] = stamp
        if _NEEDLESS.fullmatch(name):
            self._needless.add(name)


def _copy_until(copy: Copy, every_s: float, ended: threading.Event, failed: list[Exception]) -> None:
    over = False
    while not over:
        over = ended.wait(every_s)
        try:
            copy.update()
            failed.clear()
        except Exception as error:  # each store has errors of its own
            failed[:] = [error]
            log.warning("Not copied: %s", error)


# ---------------------------------------------------------------------------------------------------------- both


def _stamps(folder: Path) -> dict[str, list[int]]:
    """Size in bytes and time of the last change in nanoseconds, of each file of a folder that is to be copied."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if _is_copied(path.name) and not path.is_symlink():
            with suppress(FileNotFoundError):
                stat = path.stat()
                if path.is_file():
                    found[path.relative_to(folder).as_posix()] = [stat.st_size, stat.st_mtime_ns]
    return found


def _is_copied(name: str) -> bool:
    return name not in (lock.NAME, OWNER) and not name.endswith(".partial")


def _owner_of(folder: Path) -> dict[str, Any]:
    try:
        return dict(read_json(folder / OWNER))
    except (OSError, ValueError, TypeError):
        return {}


class _Store:
    """A place in a store. Its errors are UserErrors, but for a file that is not there."""

    def __init__(self, address: str) -> None:
        import fsspec  # which few runs need

        self.address = address
        with self._telling("reached"):
            self._files, root = fsspec.core.url_to_fs(address)
        self._root = str(root).rstrip("/")
        protocol = self._files.protocol
        protocols = {protocol} if isinstance(protocol, str) else set(protocol)
        self._is_local, self._has_folders = bool(protocols & {"file", "local"}), bool(protocols & _WITH_FOLDERS)

    def require_outside(self, folder: Path) -> None:
        """Raise a UserError if the place is in a folder, whose copy would have copies of itself."""
        if self._is_local and Path(self._root).resolve().is_relative_to(folder.resolve()):
            raise UserError(f"copy_to = {self.address} is in the run folder, {folder}: choose another address.")

    def files(self) -> dict[str, str]:
        """What tells each file from another version of it, by its name.

        Raises:
            UserError: The store cannot be read, or has a link among the files.
        """
        with self._telling("read"):
            self._files.invalidate_cache()
            try:
                found = self._files.find(self._root, detail=True)
            except FileNotFoundError:
                return {}
        inner = {path[len(self._root) + 1 :]: info for path, info in found.items()}
        inner = {name: info for name, info in inner.items() if name and _is_copied(name.rpartition("/")[2])}
        if linked := [name for name, info in inner.items() if info.get("islink")]:
            raise UserError(f"{self.address}/{linked[0]} is a link, as no run has: remove it.")
        return {name: _version(info) for name, info in inner.items()}

    def owner(self) -> str | None:
        """Who copies to this place; None where nobody does."""
        with self._telling("read"):
            try:
                content = self._files.cat_file(f"{self._root}/{OWNER}")
            except FileNotFoundError:
                return None
        found = re.search(rb'"id": "(\w{1,64})"', content)
        return None if found is None else found[1].decode()

    def get(self, name: str, to: Path) -> None:
        """Fetch a file."""
        try:
            with self._telling("read"):
                self._files.get_file(f"{self._root}/{name}", str(to))
        except FileNotFoundError as error:
            raise UserError(
                f"{self.address} changed while it was fetched: give the same command again."
            ) from error

    def put(self, name: str, content: Path | bytes) -> None:
        """Write a file whole or not at all, as object stores do.

        Raises:
            FileNotFoundError: What is to be copied, or the place, is not there.
        """
        place = f"{self._root}/{name}"
        with self._telling("written"):
            if self._has_folders:
                self._files.makedirs(place.rpartition("/")[0], exist_ok=True)
            if self._is_local:
                with written_whole(Path(place)) as partial:
                    if isinstance(content, bytes):
                        partial.write_bytes(content)
                    else:
                        shutil.copyfile(content, partial)
            elif isinstance(content, bytes):
                self._files.pipe_file(place, content)
            else:
                self._files.put_file(str(content), place)

    def remove(self, name: str) -> None:
        """Remove a file, if it is there."""
        with self._telling("written"), suppress(FileNotFoundError):
            self._files.rm_file(f"{self._root}/{name}")

    @contextmanager
    def _telling(self, what: str) -> Iterator[None]:
        """Tell in a line what a store says; each has errors of its own. That a file is not there passes."""
        try:
            yield
        except FileNotFoundError:
            raise
        except Exception as error:
            said = " ".join(str(error).split())[:200]
            raise UserError(f"{self.address} cannot be {what} ({type(error).__name__}: {said}).") from error


def _version(info: Mapping[str, Any]) -> str:
    """What changes when a file does; of a store that does not say, something that is never the same."""
    stamps = [info[key] for key in _VERSIONED_BY if info.get(key) is not None]
    return repr([info.get("size"), *stamps]) if stamps else uuid.uuid4().hex
