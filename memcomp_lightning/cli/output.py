"""Prints what a command says; a line that cannot be printed is lost, but the command goes on."""

import codecs
import errno
import io
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

_PLAIN = {"\N{BOX DRAWINGS LIGHT HORIZONTAL}": "-", "\N{PLUS-MINUS SIGN}": "+-", "\N{MIDDLE DOT}": "*"}
"""Signs of our tables in an encoding that has none of them."""


USAGE_ERROR = 2
"""Exit status when a setting is refused."""

NOT_FEASIBLE = 3
"""Exit status when the answer breaks a hard clause: there is no other, or none was found."""


def refuse(command: str, error: Exception) -> NoReturn:
    """End the command with an error message, without a traceback."""
    say(f"{command}: {error}", error=True)
    sys.exit(USAGE_ERROR)


def say(text: str = "", *, error: bool = False) -> None:
    """Print a text at once, on standard error if ``error``."""
    # The reader has gone, the disk is full, the stream is closed, or cannot spell it.
    with suppress(OSError, ValueError):
        print(text, file=sys.stderr if error else sys.stdout, flush=True)


@contextmanager
def tolerant_streams() -> Iterator[list[OSError]]:
    """Let standard output and error take everything; yield a list that collects why some of it was not written.

    Libraries print, too: loggers, progress bars, Hydra. Where the streams are closed, ``os.devnull`` takes their
    place, so that no file of the run is opened under their numbers.
    """
    before, raises, failures = (sys.stdout, sys.stderr), logging.raiseExceptions, make_tolerant()
    try:
        yield failures
    finally:
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        sys.stdout, sys.stderr = before
        logging.raiseExceptions = raises


def make_tolerant() -> list[OSError]:
    """As :func:`tolerant_streams`, for the rest of this process, which a launcher may have started."""
    codecs.register_error("readable", _spelt_out)
    logging.raiseExceptions = False  # the log of a run, too, may be on a disk that is full
    failures: list[OSError] = []
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            _occupy(number)
            setattr(sys, name, open(number, "w", encoding="utf-8", closefd=False))  # noqa: SIM115
        elif type(stream) is io.TextIOWrapper:  # no others, such as a notebook's
            tolerant = _tolerant(stream, failures if number == 1 else [])
            setattr(sys, name, tolerant)
            for handler in logging.getLogger().handlers:  # those that were made before
                if isinstance(handler, logging.StreamHandler) and handler.stream is stream:
                    handler.setStream(tolerant)
    return failures


class _Tolerant(io.RawIOBase):
    """A raw stream that reports everything as written, and keeps the first reason why something was not."""

    def __init__(self, raw: Any, name: str, failures: list[OSError]) -> None:
        self._raw, self.name, self.failures = raw, name, failures

    def write(self, data: Any) -> int:
        size = memoryview(data).nbytes
        try:
            written: int | None = self._raw.write(data)
        except (OSError, ValueError) as error:
            if not self.failures:
                self.failures.append(error if isinstance(error, OSError) else OSError(errno.EBADF, str(error)))
            return size
        return size if written is None else written

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return int(self._raw.fileno())

    def isatty(self) -> bool:
        return bool(self._raw.isatty())


def _tolerant(stream: io.TextIOWrapper, failures: list[OSError]) -> io.TextIOWrapper:
    buffer: Any = stream.buffer
    raw = getattr(buffer, "raw", buffer)
    if isinstance(raw, _Tolerant):
        return stream
    with suppress(OSError, ValueError):
        stream.flush()
    tolerant: Any = _Tolerant(raw, stream.name, failures)
    if raw is not buffer:  # not under python -u
        tolerant = io.BufferedWriter(tolerant)
    return io.TextIOWrapper(
        tolerant,
        encoding=stream.encoding,
        errors="readable",
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def _occupy(number: int) -> None:
    """Open ``os.devnull`` under the number of a closed stream."""
    try:
        os.fstat(number)
    except OSError:
        opened = os.open(os.devnull, os.O_RDWR)
        if opened != number:
            os.dup2(opened, number)
            os.close(opened)


def _spelt_out(error: UnicodeError) -> tuple[str, int]:
    """An error handler for encoders: signs of tables by plain ones, others as backslash and code."""
    assert isinstance(error, UnicodeEncodeError)
    signs = error.object[error.start : error.end]
    return "".join(_PLAIN.get(s, s.encode("ascii", "backslashreplace").decode()) for s in signs), error.end
