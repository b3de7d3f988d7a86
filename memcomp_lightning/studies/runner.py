"""Trials one after the other or in several processes; each record is written as soon as it exists."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Client, Connection, Listener
from typing import Protocol

import torch
from joblib import Parallel, delayed
from joblib.externals.loky import get_reusable_executor
from tqdm import tqdm

from memcomp_lightning.compiling import told
from memcomp_lightning.errors import require_count
from memcomp_lightning.studies.accuracy import Progress, device_of
from memcomp_lightning.studies.records import Record, Records


class Work(Protocol):
    """Trials that are trained together, as one piece of work; processes hand it to each other."""

    @property
    def title(self) -> str:
        """For people."""

    @property
    def n_updates(self) -> int:
        """How much it is, for the progress bar."""

    def run(self, progress: Progress) -> list[Record]:
        """Train and measure."""


Run = Callable[[Sequence[Work], Records], None]
"""Does work under one progress bar, and adds the records as soon as they exist."""

Do = Callable[[Sequence[Work]], Iterator[list[Record]]]


@contextmanager
def runner(name: str, *, workers: int | None = 1, accelerator: str = "cpu") -> Iterator[Run]:
    """Yield a function that trains the trials of a study, here or in several processes of one thread.

    ``workers`` None is one for each core, one in all where the trainer's setting of the accelerator is a GPU.
    """
    if workers is None:
        workers = 1 if device_of(accelerator).type != "cpu" else _n_cores()
    require_count("workers", workers)
    with tqdm(desc=name, total=0, unit="update", unit_scale=True) as bar:

        def show(what: str, n_updates: int) -> None:
            bar.set_postfix_str(what, refresh=False)
            bar.update(n_updates)
            if n_updates == 0:
                bar.refresh()

        def run(do: Do, work: Sequence[Work], records: Records) -> None:
            bar.total += sum(one.n_updates for one in work)
            for found in do(work):
                records.append(found)

        if workers == 1:
            yield partial(run, lambda work: (one.run(show) for one in work))
            return
        key = os.urandom(16)
        with Listener(authkey=key) as listener:
            threading.Thread(target=_listen, args=(listener, show), daemon=True).start()
            parallel = Parallel(
                workers,
                batch_size=1,
                max_nbytes=None,
                return_as="generator_unordered",
                initializer=_begin_worker,
                initargs=(listener.address, key),
            )
            try:
                yield partial(run, lambda work: parallel(delayed(_run_in_worker)(one) for one in work))
            finally:
                get_reusable_executor().shutdown(wait=True, kill_workers=True)


def _n_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _listen(listener: Listener, progress: Progress) -> None:
    """Take what workers say, each in a thread of its own, until the listener is closed."""
    with suppress(OSError):
        while True:
            threading.Thread(target=_pass_on, args=(listener.accept(), progress), daemon=True).start()


def _pass_on(connection: Connection, progress: Progress) -> None:
    with suppress(EOFError, OSError):  # the worker has ended
        while True:
            progress(*connection.recv())


_first: Connection | None = None
"""In a worker, the line to the first process."""


def _begin_worker(address: str | tuple[str, int], key: bytes) -> None:
    global _first
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends the others
    _first = Client(address, authkey=key)
    threading.Thread(target=_end_with, args=(_first,), daemon=True).start()
    torch.set_num_threads(1)


def _end_with(first: Connection) -> None:
    """End this worker when the connection ends: a first process that is killed cannot end its workers."""
    with suppress(EOFError, OSError):
        first.recv()
    os._exit(1)


def _run_in_worker(work: Work) -> list[Record]:
    last, waiting = time.monotonic(), 0

    def say(what: str, n_updates: int) -> None:
        if _first is not None:
            _first.send((what, n_updates))

    def report(what: str, n_updates: int) -> None:
        nonlocal last, waiting
        waiting += n_updates
        if time.monotonic() - last > 0.2:
            say(what, waiting)
            last, waiting = time.monotonic(), 0

    with told(lambda text: say(text, 0)):
        found = work.run(report)
    say(work.title, waiting)
    return found
