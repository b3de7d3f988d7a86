"""How a setting is refused: name, value, what is allowed, what to do."""

from collections.abc import Collection


class SettingError(ValueError):
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
    valid = isinstance(value, int) and not isinstance(value, bool) and value >= minimum
    require(valid, name, value, f"an integer >= {minimum}")


def require_choice(name: str, value: object, allowed: Collection[str]) -> None:
    """Raise unless ``value`` is one of ``allowed``."""
    require(value in allowed, name, value, "one of " + ", ".join(repr(option) for option in allowed))
