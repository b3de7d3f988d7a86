"""Files that are written whole or not at all."""

import csv
import io
import json
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

_waiting: ContextVar[dict[Path, Path] | None] = ContextVar("waiting", default=None)
"""Files that are written, by their places, to which they move together; None where each moves by itself."""


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give a file beside ``path`` to write; rename it on success, so that an interruption leaves the old one."""
    partial, waiting = path.with_name(f".{path.name}.{os.getpid()}.partial"), _waiting.get()
    try:
        yield partial
        if waiting is None:
            partial.replace(path)
        else:
            waiting[path] = partial
    finally:
        if waiting is None or path not in waiting:
            partial.unlink(missing_ok=True)


@contextmanager
def written_together() -> Iterator[None]:
    """Move files that are written inside to their places at the end, so that an error leaves none of them."""
    waiting: dict[Path, Path] = {}
    before = _waiting.set(waiting)
    try:
        yield
        for path, partial in waiting.items():
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
