"""Reads one input under watch: whether it was refused by a clear line, in a second and half a gigabyte."""

import re
import resource
import signal
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from memcomp_lightning.data.idx import CorruptFileError
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.modules.weights import CheckpointError
from memcomp_lightning.problems import ProblemFileError

SECONDS = 1.0
"""Of the processor, that reading an input may take."""

BYTES = 512 * 2**20
"""Above what the process had before, that reading an input may take."""

LONGEST = 2000
"""Characters of a message that people read."""

REFUSALS: tuple[type[Exception], ...] = (
    UserError,
    SettingError,
    ProblemFileError,
    CheckpointError,
    CorruptFileError,
)
"""Errors that the commands turn into a line."""

_MEMORY = re.compile(
    r"(unable|failed|n't|cannot|not) (to )?(re)?alloc|malloc|realloc|out of memory|bad_alloc", re.IGNORECASE
)


class WrongError(AssertionError):
    """An input was read, and not as it should be."""


class _TooLongError(BaseException):
    """The time is up; no reader catches it as its own."""


@dataclass(frozen=True)
class Finding:
    """What is wrong with how an input was read.

    Attributes:
        mark: Alike for findings that seem to have one cause.
        text: For people, in a line.
    """

    mark: str
    text: str


def judge(read: Callable[[], Any], *, limits: bool = True) -> Finding | None:
    """Read an input; None if it was read, or refused as it should be.

    Warnings of numbers that overflow count as errors: nobody would see them. Without ``limits`` time and memory
    are not looked at.
    """
    if limits:
        _limit_memory()
    signal.signal(signal.SIGVTALRM, _too_long)
    signal.setitimer(signal.ITIMER_VIRTUAL, (3 if limits else 60) * SECONDS)
    began = time.process_time()
    error: BaseException | None = None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", RuntimeWarning)
            read()
    except (Exception, _TooLongError) as raised:
        error = raised
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        took = time.process_time() - began
        resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    if error is not None and (finding := _of_error(error)) is not None:
        return finding
    if limits and took > SECONDS:
        return Finding(f"slow {_place(error)}", f"took {took:.1f} s")
    return None


def _too_long(_number: int, _frame: FrameType | None) -> NoReturn:
    raise _TooLongError


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, resource.RLIM_INFINITY))


def _of_error(error: BaseException) -> Finding | None:
    kind, first = type(error).__name__, str(error).partition("\n")[0][:200]
    if isinstance(error, _TooLongError):
        return Finding(f"hang {_place(error)}", f"took more than {3 * SECONDS:g} s at {_place(error)}")
    if isinstance(error, WrongError):
        return Finding(f"wrong {first[:40]}", f"was read wrongly: {first}")
    for cause in _chain(error):
        if isinstance(cause, MemoryError) or _MEMORY.search(str(cause)):
            asked = f"asks for more than {BYTES // 2**20} MiB at {_place(error)}: {first}"
            return Finding(f"memory {_place(cause)}", asked)
    if not isinstance(error, REFUSALS):
        return Finding(f"{kind} {_place(error)}", f"{kind} at {_place(error)}: {first}")
    if trouble := unclear(str(error)):
        mark = trouble.split(",")[0]
        return Finding(f"{mark} {_place(error)}", f"{kind} at {_place(error)} {trouble}: {first!r}")
    return None


def unclear(message: str) -> str | None:
    """What keeps a message from being a clear line; None if nothing does."""
    if not message.strip():
        return "says nothing"
    if "\n" in message:
        return "has several lines"
    if not message.isprintable():
        return "has signs that cannot be printed"
    if len(message) > LONGEST:
        return f"is too long, {len(message)} characters"
    return None


def _chain(error: BaseException | None) -> list[BaseException]:
    found: list[BaseException] = []
    while error is not None and error not in found:
        found.append(error)
        error = error.__cause__ or error.__context__
    return found


def _place(error: BaseException | None) -> str:
    """File and line of this package where an error began."""
    if error is None:
        return ""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "memcomp_lightning" in frame.filename]
    last = (own or list(frames) or [None])[-1]
    return "" if last is None else f"{'/'.join(Path(last.filename).parts[-2:])}:{last.lineno}"
