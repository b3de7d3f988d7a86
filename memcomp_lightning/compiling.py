"""Tell the user why the first use of a compiled kernel takes a while."""

import logging
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

log = logging.getLogger(__name__)

_begun: list[float] = []
_spent: list[float] = []


def seconds_spent() -> float:
    """Seconds that numba has compiled or loaded in this process since :func:`announce_compilation`."""
    return sum(_spent)


def n_threads() -> int:
    """Threads for compiled code: as many as torch uses, or without torch OMP_NUM_THREADS or one a processor."""
    if "torch" in sys.modules:
        return int(sys.modules["torch"].get_num_threads())
    from numba import config

    given = os.environ.get("OMP_NUM_THREADS", "").partition(",")[0]
    return int(given) if given.isdecimal() and int(given) else int(getattr(config, "NUMBA_NUM_THREADS", 1))


_PARTS = {"likelihood": "the likelihood's kernel", "twister": "the draws"}


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

    class Clock(event.Listener):
        def on_start(self, event: Any) -> None:
            if not _begun:
                _spent.append(0.0)
            _begun.append(time.perf_counter())

        def on_end(self, event: Any) -> None:
            begin = _begun.pop()
            if not _begun:  # what is compiled for another function counts with it
                _spent[-1] = time.perf_counter() - begin

    event.register("numba:compile", Announcement())  # type: ignore[no-untyped-call]
    event.register("numba:compiler_lock", Clock())  # type: ignore[no-untyped-call]


@contextmanager
def told(tell: Callable[[str], object]) -> Iterator[None]:
    """Hand what is logged here to a function, whatever is set up for logs otherwise."""
    handler, before = logging.Handler(), (log.level, log.propagate)
    handler.emit = lambda record: tell(record.getMessage())  # type: ignore[assignment, method-assign]
    log.addHandler(handler)
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        yield
    finally:
        log.removeHandler(handler)
        log.setLevel(before[0])
        log.propagate = before[1]


@cache
def _log_once(what: str) -> None:
    log.info("compiling %s for this processor, once (about half a minute)", what)
