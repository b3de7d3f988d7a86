"""Values as Hydra's command line writes them."""

import re
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

_UNREADABLE = object()


def hydra_value(text: str) -> object:
    """The value that Hydra reads; ``_UNREADABLE``, which equals no value, where it cannot read the text."""
    try:
        return OverridesParser.create().parse_override(f"x={text}").value()
    except HydraException:
        return _UNREADABLE


def with_path(name: str, path: Path | str) -> str:
    """An override that gives a path, in quotes unless Hydra reads it without.

    >>> with_path("hydra.run.dir", "my runs/a,b")
    "hydra.run.dir='my runs/a,b'"
    """
    return f"{name}={quoted(str(path))}"


def quoted(text: str) -> str:
    """A text, in quotes unless Hydra reads it without."""
    if hydra_value(text) == text:
        return text
    escaped = re.sub(r"(\\+)$", r"\1\1", re.sub(r"(\\*)'", r"\1\1\\'", text))
    return f"'{escaped}'"
