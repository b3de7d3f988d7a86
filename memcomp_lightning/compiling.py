"""A word about the first use of compiled kernels, which takes a while."""

import logging
from functools import cache
from typing import Any

log = logging.getLogger(__name__)

_PARTS = {"likelihood": "the likelihood's kernel"}


@cache
def announce_compilation() -> None:
    """Log, at level INFO and once a process, that kernels of this package are being compiled.

    Where numba finds them compiled on disk, nothing is logged.
    """
    from numba.core import event

    class Announcement(event.Listener):
        def on_start(self, event: Any) -> None:
            package, _, name = str(event.data["dispatcher"].py_func.__module__).partition(".")
            if package == __package__:
                _log_once(_PARTS.get(name.partition(".")[0], "the solver's kernels"))

        def on_end(self, event: Any) -> None:
            pass

    event.register("numba:compile", Announcement())  # type: ignore[no-untyped-call]


@cache
def _log_once(what: str) -> None:
    log.info("compiling %s for this processor, once (about half a minute)", what)
