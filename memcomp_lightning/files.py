"""Files that are written whole or not at all, and files of others, which are read with care."""

import csv
import dataclasses
import glob
import io
import json
import os
import platform
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from memcomp_lightning.errors import UserError

T = TypeVar("T")

LARGEST_JSON = 256 * 2**20
"""Bytes of a file that is read whole: more than any that this package writes."""

_MACHINE = platform.node().partition(".")[0] or "here"
"""Stands in the names of files that are being written: a process number says nothing on another machine."""

_tidied: set[tuple[int, Path]] = set()
"""Folders in which a process has written, with its number: a fork is another."""

_waiting: ContextVar[dict[Path, Path] | None] = ContextVar("waiting", default=None)
"""Files that are written, by their places, to which they move together; None where each moves by itself."""


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a file beside ``path`` to write; rename it on success, so that an interruption leaves the old one.

    The first file of a process in a folder takes away what processes that were killed had begun there.
    """
    _tidy(path.parent)
    partial, waiting = path.with_name(f".{path.name}.{_MACHINE}.{os.getpid()}.partial"), _waiting.get()
    try:
        with naming(path):
            yield partial
            if waiting is None:
                partial.replace(path)
            else:
                waiting[path] = partial
    finally:
        if waiting is None or path not in waiting:
            with suppress(OSError):
                partial.unlink(missing_ok=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let an error of the system name the file that it is about; that of a full disk names none."""
    try:
        yield
    except OSError as error:
        if error.errno is not None:
            error.filename, error.filename2 = str(path), None
        raise


def _tidy(folder: Path) -> None:
    """Remove files that processes of this machine began in a folder, and did not live to finish."""
    at = folder.absolute()
    if (os.getpid(), at) in _tidied:
        return
    _tidied.add((os.getpid(), at))
    with suppress(OSError):  # no folder; nothing of ours
        for path in at.glob(f".*.{_MACHINE}.*.partial"):
            writer = path.name.split(".")[-2]
            if writer.isdecimal() and int(writer) != os.getpid() and not lives(int(writer)):
                path.unlink()


def lives(process: int) -> bool:
    """Whether this machine has a process of such a number; on Windows, where that cannot be asked, yes."""
    if os.name == "nt":  # a signal of 0 is no question there
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # somebody else's
        return True
    return True


@contextmanager
def written_together() -> Iterator[None]:
    """Move files that are written inside to their places at the end, so that an error leaves none of them."""
    waiting: dict[Path, Path] = {}
    before = _waiting.set(waiting)
    try:
        yield
        for path, partial in waiting.items():
            with naming(path):
                partial.replace(path)
    finally:
        _waiting.reset(before)
        for partial in waiting.values():
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a file so that an interruption leaves the old one or the new one."""
    with written_whole(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: Path, content: object) -> None:
    """Write plain values as :func:`write_text` does, a line each."""
    write_text(path, json.dumps(content, indent=1) + "\n")


def as_csv(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as the text of a CSV file."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue()


def read_json(path: Path) -> Any:
    """Plain values of a file.

    Raises:
        OSError: It cannot be read.
        ValueError: It is too large, nested too deeply, or no JSON.
    """
    if (size := path.stat().st_size) > LARGEST_JSON:
        raise ValueError(f"it has {size} bytes, more than the {LARGEST_JSON} that are read")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except UnicodeDecodeError:
        raise ValueError("it is no text in UTF-8") from None
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def made_of(kind: type[T], content: object) -> T:
    """An instance of a dataclass from the plain values of a file: its fields by name, each of its type.

    Raises:
        ValueError: A field is missing, not known, or of another type; the message names it.

    >>> @dataclasses.dataclass
    ... class Point:
    ...     x: float
    ...     names: list[str] | None = None
    >>> made_of(Point, {"x": 1})
    Point(x=1, names=None)
    >>> made_of(Point, {"x": "1"})
    Traceback (most recent call last):
    ValueError: x is '1', expected float
    """
    if not isinstance(content, dict):
        raise ValueError(f"it is {_short(content)}, expected an object with named values")
    of: Any = kind
    fields, hints = dataclasses.fields(of), _hints(of)
    if unknown := set(content) - {field.name for field in fields}:
        raise ValueError(f"{_short(min(unknown))} is not known here")
    for field in fields:
        hint = hints[field.name]
        if field.name not in content:
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
                raise ValueError(f"{field.name} is missing")
        elif not _is_of(content[field.name], hint):
            expected = str(hint) if get_args(hint) else hint.__name__
            raise ValueError(f"{field.name} is {_short(content[field.name])}, expected {expected}")
    return kind(**content)


_hints: Any = cache(get_type_hints)


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _is_of(value: object, hint: Any) -> bool:
    """Whether a plain value of JSON is of a type; lists stand for tuples, whole numbers for others."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint is Any:
        return True
    if origin in (Union, UnionType):
        return any(_is_of(value, one) for one in inner)
    if origin in (list, tuple):
        return isinstance(value, list) and all(_is_of(entry, inner[0]) for entry in value)
    if origin is dict:
        pairs = value.items() if isinstance(value, dict) else ()
        return isinstance(value, dict) and all(_is_of(entry, inner[1]) for _, entry in pairs)
    if hint in (int, float):
        return isinstance(value, (int, hint)) and not isinstance(value, bool)
    return isinstance(value, hint or NoneType)


def stamp(path: Path) -> tuple[Path, int, int, int] | None:
    """What tells a file from one that stood, or stands later, at the same path; None where there is none.

    The same path may also mean another file after a change of the working directory: the stamp has the whole path,
    the number of the file in its file system, its size in bytes and the time of its last change in nanoseconds.
    """
    try:
        found = path.stat()
    except OSError:
        return None
    return path.absolute(), found.st_ino, found.st_size, found.st_mtime_ns


def meant_by(path: str) -> list[Path]:
    """The files that a path means, by name: those in a folder, those that match a pattern, or itself."""
    alone = Path(path)
    if alone.is_dir():
        return sorted(file for file in alone.iterdir() if file.is_file())
    if not os.path.exists(path) and glob.has_magic(path):  # noqa: PTH110 (a pattern may be no possible name)
        return sorted(file for file in map(Path, glob.glob(path, recursive=True)) if file.is_file())  # noqa: PTH207
    return [alone]


def inside(folder: Path, name: str) -> Path:
    """The place of a name in a folder.

    Raises:
        UserError: The name leads out of the folder, as it may where a stranger wrote it.
    """
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise UserError(f"{folder}: the name {name!r} leads out of this folder, where nothing is read or written.")
    return path
