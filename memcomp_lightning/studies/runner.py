"""Processes that train many networks."""

import logging
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from multiprocessing.context import BaseContext
from typing import Any

import torch
from tqdm import tqdm

from memcomp_lightning import compiling
from memcomp_lightning.errors import require_count
from memcomp_lightning.studies.accuracy import Progress, device_of
from memcomp_lightning.studies.records import JsonLines


def _n_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


Runner = Callable[[Sequence[Any], Progress], Iterator[list[Any]]]


@contextmanager
def runner(workers: int | None, accelerator: str, train: Callable[[Any, Progress], list[Any]]) -> Iterator[Runner]:
    """What trains many units: this process, or several others, each on one thread.

    Args:
        workers: Processes; None is one for each core, one in all with a GPU.
        accelerator: The trainer's setting.
        train: Trains one unit and returns its records; a function of a module, which processes can import.
    """
    if workers is None:
        workers = 1 if device_of(accelerator).type != "cpu" else _n_cores()
    require_count("workers", workers)
    if workers == 1:
        yield partial(_run_here, train)
        return
    context = _processes_that_import_once(train.__module__)
    messages = context.SimpleQueue()
    pool = ProcessPoolExecutor(workers, context, initializer=_begin_worker, initargs=(messages,))
    try:
        yield partial(_run_in_pool, pool, messages, train)
    except BaseException:
        for process in list(pool._processes.values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _processes_that_import_once(module: str) -> BaseContext:
    """Where the system allows it, forks of one process that has imported a module: torch takes seconds."""
    if sys.platform != "linux":  # its libraries may not be forked, or nothing may
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([module])
    return context


def run_all(run: Runner, units: Sequence[Any], records: JsonLines[Any], name: str) -> None:
    """Train units under one progress bar; each record is written when it exists."""
    with tqdm(total=sum(unit.n_updates for unit in units), unit="update", unit_scale=True) as bar:
        bar.set_description(name)

        def show(what: str, n_updates: int) -> None:
            bar.set_description(f"{name}: {what}", refresh=False)
            bar.update(n_updates)
            if n_updates == 0:
                bar.refresh()

        for found in run(units, show):
            records.append(found)


def _run_here(train: Any, units: Sequence[Any], progress: Progress) -> Iterator[list[Any]]:
    for unit in units:
        yield train(unit, progress)


def _run_in_pool(
    pool: ProcessPoolExecutor, messages: Any, train: Any, units: Sequence[Any], progress: Progress
) -> Iterator[list[Any]]:
    running = {pool.submit(_run_in_worker, train, unit) for unit in units}
    while running:
        done, running = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
        while not messages.empty():
            progress(*messages.get())
        for future in done:
            yield future.result()


_messages: Any = None
"""Where a worker process says what it is doing."""


def _begin_worker(messages: Any) -> None:
    global _messages
    _messages = messages
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends the others
    tell = logging.Handler()
    tell.emit = lambda record: messages.put((record.getMessage(), 0))  # type: ignore[method-assign]
    log = logging.getLogger(compiling.__name__)
    log.addHandler(tell)
    log.setLevel(logging.INFO)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)


def _end_with_parent() -> None:
    """A first process that is killed cannot end the others."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run_in_worker(train: Any, unit: Any) -> list[Any]:
    last, waiting = time.monotonic(), 0

    def report(what: str, n_updates: int) -> None:
        nonlocal last, waiting
        waiting += n_updates
        if time.monotonic() - last > 0.2:
            _messages.put((what, waiting))
            last, waiting = time.monotonic(), 0

    records: list[Any] = train(unit, report)
    _messages.put((unit.title, waiting))
    return records
