"""Trials one after the other or in several processes; each record is written as soon as it exists."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Protocol

import torch
from tqdm import tqdm

from memcomp_lightning.compiling import told
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.processes import processes, say
from memcomp_lightning.studies.accuracy import Progress, device_of
from memcomp_lightning.studies.cluster import CLUSTERS, cluster
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
def runner(name: str, *, workers: int | str | None = 1, accelerator: str = "cpu") -> Iterator[Run]:
    """Yield a function that trains the trials of a study, here or in several processes of one thread.

    ``workers`` None is one for each core, one in all where the trainer's setting of the accelerator is a GPU;
    ``"dask"`` and ``"ray"`` are those of a cluster.
    """
    if workers is None:
        workers = 1 if device_of(accelerator).type != "cpu" else _n_cores()
    elsewhere = workers in CLUSTERS
    if not elsewhere:
        require(not isinstance(workers, str), "workers", workers, f"an integer >= 1, {' or '.join(CLUSTERS)}")
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

        if elsewhere:
            with cluster(str(workers)) as send:
                yield partial(run, lambda work: _heard(send(_run_elsewhere, work), show))
            return
        if workers == 1:
            yield partial(run, lambda work: (one.run(show) for one in work))
            return
        with processes(int(workers), show) as do:
            yield partial(run, partial(do, _run_in_worker))


def _n_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _heard(
    found: Iterator[tuple[str, int, list[Record]]], show: Callable[[str, int], None]
) -> Iterator[list[Record]]:
    """Show work that was done on other machines as it is done."""
    for title, n_updates, records in found:
        show(title, n_updates)
        yield records


def _run_elsewhere(work: Work) -> tuple[str, int, list[Record]]:
    torch.set_num_threads(1)
    return work.title, work.n_updates, work.run(lambda what, n_updates: None)


def _run_in_worker(work: Work) -> list[Record]:
    torch.set_num_threads(1)
    last, waiting = time.monotonic(), 0

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
