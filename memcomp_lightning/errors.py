"""How a setting is refused: name, value, what is allowed, what to do."""

import errno
from collections.abc import Collection
from numbers import Integral


class Told(Exception):  # noqa: N818 (what errors have in common, none by itself)
    r"""An error that is told to people: signs that cannot be printed are spelt out: strangers' files hold any.

    >>> str(UserError("column 'a\x1b[2J' is empty"))
    "column 'a\\x1b[2J' is empty"
    """

    def __str__(self) -> str:
        text = printable(super().__str__())
        return text if len(text) <= LONGEST_MESSAGE else f"{text[: LONGEST_MESSAGE - 505]} ... {text[-500:]}"


LONGEST_MESSAGE = 2000
"""Characters. A cell of a damaged file may be as long as the file; what to do stands at the end."""


def printable(text: str) -> str:
    """A text without signs that move a terminal's cursor or cannot be seen; line breaks stay."""
    if text.replace("\n", "").isprintable():
        return text
    return "".join(sign if sign.isprintable() or sign == "\n" else repr(sign)[1:-1] for sign in text)


class UserError(Told):
    """Something that the user can put right; the message says how."""


class LostError(UserError):
    """Something outside of the run ended it; what it was is said, and not how to go on."""


class SettingError(Told, ValueError):
    """A setting that does not exist or is out of range, met at construction."""


def require(condition: bool, name: str, value: object, allowed: str, remedy: str = "") -> None:
    """Raise unless ``condition`` holds.

    Args:
        condition: What must be true of the value.
        name: The setting, as the user writes it.
        value: What the user gave.
        allowed: The permitted values, in words.
        remedy: What to do about it, if the permitted values do not say it.

    Raises:
        SettingError: ``name = value is not allowed: expected ... .``

    >>> require(0 < 1, "k", 1, "an integer >= 1")
    """
    if not condition:
        message = f"{name} = {value!r} is not allowed: expected {allowed}."
        raise SettingError(f"{message} {remedy}".rstrip())


def require_count(name: str, value: object, minimum: int = 1) -> None:
    """Raise unless ``value`` is an integer of at least ``minimum``."""
    valid = isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= minimum
    whole = isinstance(value, float) and value.is_integer()
    require(valid, name, value, f"an integer >= {minimum}", f"Write {value:.0f}." if whole else "")


def require_choice(name: str, value: object, allowed: Collection[str]) -> None:
    """Raise unless ``value`` is one of ``allowed``."""
    require(value in allowed, name, value, "one of " + ", ".join(repr(option) for option in allowed))


def require_some(name: str, values: Collection[object] | None, allowed: str) -> None:
    """Raise if ``values`` are given, but none of them."""
    require(values is None or len(values) > 0, name, values, allowed)


def require_parts(name: str, value: object, kind: str, parts: Collection[str]) -> None:
    """Raise unless ``value`` has the methods and attributes that a protocol asks for.

    >>> require_parts("solver", 3, "solver", ["minimise"])
    Traceback (most recent call last):
    memcomp_lightning.errors.SettingError: solver = 'int' is not allowed: expected a solver, which has minimise.
    """
    given = value if isinstance(value, str) else getattr(value, "__name__", type(value).__name__)
    missing = [part for part in parts if not hasattr(value, part)]
    complete = not missing and not isinstance(value, type)
    wanted = f", which has {', '.join(missing)}" if missing else ": an object, no class"
    remedy = f"Make one: {given}(...)." if isinstance(value, type) and not missing else ""
    require(complete, name, given, f"a {kind}{wanted}", remedy)


_OF_THE_MACHINE = frozenset(
    getattr(errno, name)
    for name in ("ENOSPC", "EDQUOT", "EIO", "EROFS", "ENOMEM", "EMFILE", "ENFILE", "EAGAIN", "ESTALE", "ENOTCONN")
    if hasattr(errno, name)
)
"""Errors of a full or lost disk, of memory, and of limits: nothing that was typed is wrong."""

_MEMORY = ("allocate memory", "out of memory", "failed to map segment", "start new thread", "OpenBLAS")


def lost(error: BaseException, *, any_file: bool = False) -> str | None:
    """What the machine did not give, as a sentence; None where an error is of another kind.

    With ``any_file`` each error of the system counts, such as that of a folder that has vanished: where a run has
    begun, nothing that was typed is wrong.

    >>> lost(MemoryError())
    'memory ran out.'
    >>> lost(OSError(errno.ENOSPC, "No space left on device", "run/stages.json"))
    'run/stages.json cannot be written (No space left on device).'
    """
    if isinstance(error, LostError):
        return str(error)
    if isinstance(error, OSError) and error.errno not in (None, errno.ENOMEM):
        if not any_file and error.errno not in _OF_THE_MACHINE:
            return None
        does = "written" if error.errno in _FULL else "read or written"
        return f"{error.filename or 'a file'} cannot be {does} ({error.strerror})."
    hidden = isinstance(error, RuntimeError | ImportError | OSError) and any(
        part in str(error) for part in _MEMORY
    )
    return "memory ran out." if isinstance(error, MemoryError) or hidden else None


_FULL = frozenset((errno.ENOSPC, errno.EROFS, getattr(errno, "EDQUOT", errno.ENOSPC)))
