"""Work done in several processes of one thread each, with results as soon as they exist."""

import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.connection import Client, Connection, Listener
from typing import Any, TypeVar

from joblib import Parallel, delayed
from joblib.externals.loky import get_reusable_executor

from memcomp_lightning.errors import LostError

T = TypeVar("T")

Do = Callable[[Callable[[Any], T], Iterable[Any]], Iterator[T]]
"""Applies a function to each piece of work, and yields what it returns, whichever comes first."""


@contextmanager
def processes(n: int, heard: Callable[..., object]) -> Iterator[Do[Any]]:
    """Yield a function that does work in ``n`` processes, which end when this context does.

    Ctrl-C reaches the first process alone. ``heard`` is called here with what is given to :func:`say` there.

    Raises:
        LostError: A process was killed.
    """
    key = os.urandom(16)
    with Listener(authkey=key) as listener:
        threading.Thread(target=_listen, args=(listener, heard), daemon=True).start()
        parallel = Parallel(
            n,
            batch_size=1,
            max_nbytes=None,
            return_as="generator_unordered",
            initializer=_begin_worker,
            initargs=(listener.address, key),
        )
        begun: list[Generator[Any, None, None]] = []

        def do(function: Callable[[Any], Any], work: Iterable[Any]) -> Iterator[Any]:
            begun.append(parallel(delayed(function)(one) for one in work))
            return begun[-1]

        done = False
        try:
            yield do
            done = True
        except BrokenProcessPool as error:
            reason = "a process was ended from outside, perhaps as memory ran out: fewer of them need less."
            raise LostError(f"{reason} What is finished is kept.") from error
        except BaseException as error:
            for results in begun:  # what still runs is ended; otherwise it would be waited for
                with suppress(type(error)):
                    results.throw(error)
            raise
        finally:
            # Killed processes leave semaphores, about which Python complains at its end.
            get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=not done)


def say(*what: object) -> None:
    """From work to the process that gave it."""
    if _first is not None:
        _first.send(what)


def _listen(listener: Listener, heard: Callable[..., object]) -> None:
    """Take what workers say, each in a thread of its own, until the listener is closed."""
    with suppress(OSError):
        while True:
            threading.Thread(target=_pass_on, args=(listener.accept(), heard), daemon=True).start()


def _pass_on(connection: Connection, heard: Callable[..., object]) -> None:
    with suppress(EOFError, OSError):  # the worker has ended
        while True:
            heard(*connection.recv())


_first: Connection | None = None
"""In a worker, the line to the first process."""


def _begin_worker(address: str | tuple[str, int], key: bytes) -> None:
    global _first
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends the others
    os.environ["OMP_NUM_THREADS"] = "1"
    _first = Client(address, authkey=key)
    threading.Thread(target=_end_with, args=(_first,), daemon=True).start()


def _end_with(first: Connection) -> None:
    """End this worker when the connection ends: a first process that is killed cannot end its workers."""
    with suppress(EOFError, OSError):
        first.recv()
    os._exit(1)
