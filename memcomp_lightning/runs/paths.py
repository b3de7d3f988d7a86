"""Which settings hold paths: those are meant from the folder where they were typed."""

import re

_NAMES = re.compile(
    r"(.*\.)?(\w+_)?(problem|continue|weights|path|file|filename|dir|dirpath|folder|root)"
    r"|data\.(source\.)?(validation|test)|density\.peers"
)


def is_path(name: str) -> bool:
    """Whether a setting holds a path: a problem, weights, a folder."""
    return _NAMES.fullmatch(name.lstrip("+")) is not None
