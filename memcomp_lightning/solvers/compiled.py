"""Hand problems to compiled kernels and restarts to threads: what all compiled solvers share."""

import importlib.util
import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning import compiling, rng
from memcomp_lightning.arrays import AnyArray, Array, alike, namespace, to_numpy
from memcomp_lightning.compiling import n_threads
from memcomp_lightning.errors import require, require_choice
from memcomp_lightning.problems.graph import Bipartite, EdgeList
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, Status

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator

Numbers = NDArray[Any]


# ----------------------------------------------------------------------------------------------------- the problem


class Layers(NamedTuple):
    """Two fully coupled layers, problems on one axis.

    Attributes:
        couplings: Of each unit of the second layer, ``(n_problems, n_second, n_first)``.
        own: The linear part, ``(n_problems, n)``.
    """

    couplings: Numbers
    own: Numbers

    @property
    def size(self) -> int:
        """Couplings of a problem."""
        return self.couplings[0].size

    @property
    def strength(self) -> Numbers:
        """Sum of the sizes of the couplings of each variable, ``(n_problems, n)``."""
        size = np.abs(self.couplings)
        return np.concatenate((size.sum(1, dtype=np.float64), size.sum(2, dtype=np.float64)), axis=1)

    def rows(self, converted: Callable[[Numbers], Numbers]) -> tuple[Numbers, ...]:
        """The couplings of each unit of the first layer, ``(n_problems, n_first, n_second)``; of the second."""
        of_second = converted(self.couplings)
        return np.ascontiguousarray(of_second.transpose(0, 2, 1)), of_second


class Neighbours(NamedTuple):
    """Listed pairs, seen from each variable, problems on one axis.

    Attributes:
        begins: Where the neighbours of each variable begin, ``(n + 1,)``.
        variables: The neighbours, ``(n_entries,)``; each pair stands there twice.
        couplings: ``(n_problems, n_entries)``.
        own: The linear part, ``(n_problems, n)``.
    """

    begins: Numbers
    variables: Numbers
    couplings: Numbers
    own: Numbers

    @property
    def size(self) -> int:
        """Couplings of a problem."""
        return len(self.variables) // 2

    @property
    def strength(self) -> Numbers:
        """Sum of the sizes of the couplings of each variable, ``(n_problems, n)``."""
        total = np.cumsum(np.abs(self.couplings), axis=1, dtype=np.float64)
        total = np.concatenate((np.zeros((len(total), 1)), total), axis=1)
        return np.diff(total[:, self.begins], axis=1)

    def rows(self, converted: Callable[[Numbers], Numbers]) -> tuple[Numbers, ...]:
        """Where the neighbours of each variable begin, the neighbours and the couplings with them."""
        return self.begins, self.variables, converted(self.couplings)


def seen_from_variables(qubo: Qubo) -> Layers | Neighbours:
    """The couplings of each variable, as the kernels read them."""
    coupling, own = to_numpy(qubo.coupling), to_numpy(qubo.linear).astype(np.float64)
    own = own.reshape(math.prod(qubo.problems), qubo.n)
    if isinstance(qubo.graph, Bipartite):
        return Layers(np.ascontiguousarray(coupling.reshape(-1, *qubo.graph.edge_shape)), own)
    pairs = to_numpy(qubo.graph.edges())
    order, begins = grouped(pairs.T.ravel(), qubo.n)
    others = np.concatenate((pairs[:, 1], pairs[:, 0]))[order]
    twice = np.tile(coupling.reshape(len(own), -1), 2)
    return Neighbours(begins, others, np.ascontiguousarray(twice[:, order]), own)


def grouped(variable: Numbers, n: int) -> tuple[Numbers, Numbers]:
    """Order that groups entries by variable, and where each variable's group begins, ``(n + 1,)``."""
    counts = np.bincount(variable, minlength=n)
    return np.argsort(variable, kind="stable"), np.concatenate(([0], np.cumsum(counts)))


SPARSE = 0.25
"""Share of the couplings of two layers below which a list is faster than a matrix."""


def without_zeros(qubo: Qubo) -> Qubo:
    """Turn two layers with few couplings other than zero into a list of pairs, which is faster."""
    if not isinstance(qubo.graph, Bipartite):
        return qubo
    used = _used(qubo)
    return qubo if used.sum() > SPARSE * len(used) else listed(qubo, used)


def _used(qubo: Qubo) -> Array:
    """Which couplings are not zero in some problem, ``(n_pairs,)``."""
    return (qubo.coupling != 0).reshape(math.prod(qubo.problems), -1).any(0)


def listed(qubo: Qubo, used: Array | None = None) -> Qubo:
    """The problem with the couplings that are used as a list of pairs; None are those that are not zero."""
    flat, used = qubo.coupling.reshape(*qubo.problems, -1), _used(qubo) if used is None else used
    pairs = alike(qubo.graph.edges(), used)[used]
    return Qubo(EdgeList(n=qubo.n, pairs=pairs), flat[..., used], qubo.linear, qubo.offset)


def power_of_two(*parts: AnyArray) -> Numbers:
    """A power of two above the largest number of each problem, ``(n_problems,)``: over it, integers stay exact.

    Args:
        parts: ``(n_problems, ...)`` each.
    """
    flat = [to_numpy(part).reshape(len(part), -1) for part in parts]
    ends = [end.astype(np.float64) for part in flat for end in (part.max(1, initial=0), -part.min(1, initial=0))]
    return np.exp2(np.frexp(np.max(ends, axis=0).clip(min=1e-300))[1])


def over(part: AnyArray, unit: Numbers) -> Numbers:
    """Numbers of each problem in its unit, in float32."""
    numbers = to_numpy(part)
    return float32(numbers / unit.reshape(-1, *(1,) * (numbers.ndim - 1)))


def float32(x: AnyArray) -> Numbers:
    """A contiguous float32 array."""
    return np.ascontiguousarray(to_numpy(x), np.float32)


def solution_of(
    qubo: Qubo,
    x: Array,
    begin: float,
    *,
    steps: int,
    status: Array | None = None,
    was_run: Array | None = None,
    in_time: bool = True,
) -> QuboSolution:
    """What a search returns.

    Args:
        qubo: The problems.
        x: The state of each restart, ``(*problems, n_restarts, n)``.
        begin: Time of ``time.perf_counter()`` when it began, less what compilation took until then.
        steps: Steps or sweeps of each restart.
        status: How each restart ended, ``(*problems, n_restarts)``; None is STEP_BUDGET.
        was_run: Which were run, ``(*problems, n_restarts)`` bool; None is all.
        in_time: Whether all came to their end.
    """
    xp = namespace(x)
    each = xp.ones(x.shape[:-1], dtype=xp.int64, device=x.device)
    status = each * int(Status.STEP_BUDGET) if status is None else status
    status = status if in_time else each * int(Status.STOPPED)
    energies = qubo.energy(x)
    if was_run is not None:
        status, energies = xp.where(was_run, status, int(Status.NOT_RUN)), xp.where(was_run, energies, xp.inf)
    wall_time_s = time.perf_counter() - compiling.seconds_spent() - begin
    return QuboSolution(x, energies, status, each * steps, wall_time_s)


# ----------------------------------------------------------------------------------------------------- the threads


def seeds(n: int, generator: "Generator") -> NDArray[np.uint64]:
    """A seed for each piece of work, so that the answer does not depend on the number of threads."""
    return to_numpy(rng.integers(2**62, (n,), generator=generator, like=np.zeros(0))).astype(np.uint64)


def check_kernel(kernel: str, obstacle_here: str | None = None, others: Sequence[str] = ()) -> None:
    """Refuse an unknown kernel, and a compiled one where something speaks against it."""
    require_choice("kernel", kernel, ("auto", "compiled", "reference", *others))
    if kernel not in ("auto", "reference"):
        reason = obstacle_here or obstacle("cpu")
        require(reason is None, "kernel", kernel, "'auto' or 'reference' here", reason or "")


def device_of(x: Array) -> str:
    """The kind of device that ``x`` lies on; numpy's arrays lie on the CPU."""
    return str(getattr(x.device, "type", "cpu"))


def obstacle(device: str) -> str | None:
    """Why compiled kernels cannot run, and what to do; None if they can."""
    if device != "cpu":
        return f"The problem is on {device}: the plain kernel runs there."
    if importlib.util.find_spec("numba") is None:
        return "numba is not installed: the plain kernel is many times slower. pip install numba"
    return _import_failure()


@cache
def _import_failure() -> str | None:
    try:
        from memcomp_lightning.solvers.kernels import random  # noqa: F401
    except (ImportError, RuntimeError) as error:  # the second: no folder to keep compiled code in
        return f"numba: {error}. The plain kernel is many times slower; try NUMBA_CACHE_DIR=a folder of yours."
    return None


def share(
    kernel: Any,
    n_items: int,
    work: float,
    arguments: tuple[Any, ...],
    inlined: Sequence[ModuleType] = (),
    *,
    anytime: bool = False,
) -> bool:
    """Run items 0 to ``n_items - 1`` on as many threads as there are; return whether all came to their end.

    Compiled code is deaf to Ctrl-C: what takes long runs on threads of its own, which this one tells to stop.

    Args:
        kernel: Called with the first item, one past the last, an array that is other than 0 to stop it, and
            ``arguments``.
        n_items: Independent pieces of work.
        work: Operations in all, about.
        arguments: The kernel's.
        inlined: Modules whose functions become part of the kernel.
        anytime: Whether a kernel that is stopped has written what it found: it obeys :func:`limited`.
    """
    forget_outdated(kernel, tuple(inlined))
    stop, limit = np.zeros(1, np.uint8), _LIMIT.get() if anytime else None
    most, left = min(n_threads(), n_items), math.inf if limit is None else limit.until - time.perf_counter()
    if most <= 1 and work < _SHORT and left > _SHORT_S:
        kernel(0, n_items, stop, *arguments)
        return True
    if not kernel.signatures:
        before = compiling.seconds_spent()
        kernel(0, 0, stop, *arguments)  # compiles once, not on every thread
        if limit is not None:
            limit.until += compiling.seconds_spent() - before
            left = limit.until - time.perf_counter()
    cuts = np.linspace(0, n_items, min(n_items, 4 * most) + 1).astype(int).tolist()
    jobs = [_pool(most).submit(kernel, a, b, stop, *arguments) for a, b in pairwise(cuts)]
    try:
        _, late = wait(jobs, None if left == math.inf else max(left, 0.0))
        stop[0] = 1
        for job in jobs:
            job.result()
        return not late
    except BaseException as error:
        stop[0] = 1
        wait(jobs)
        if limit is None or not isinstance(error, KeyboardInterrupt):
            raise
        limit.until, limit.interrupted = 0.0, True
        return False


@dataclass(slots=True)
class Limit:
    """When searches end, and whether Ctrl-C came first.

    Attributes:
        until: Time of ``time.perf_counter()``.
        interrupted: Whether Ctrl-C ended a search.
    """

    until: float
    interrupted: bool = False

    @property
    def is_past(self) -> bool:
        """Whether a search should end now."""
        return self.interrupted or time.perf_counter() >= self.until


def limit_here() -> Limit | None:
    """The limit of the context, if there is one."""
    return _LIMIT.get()


_LIMIT: ContextVar[Limit | None] = ContextVar("limit", default=None)


@contextmanager
def limited(until: float) -> Iterator[Limit]:
    """Within this context annealing, crossover and tabu search end in time, or at Ctrl-C, with what they found.

    Args:
        until: Time of ``time.perf_counter()``, or infinity.
    """
    token = _LIMIT.set(limit := Limit(until))
    try:
        yield limit
    finally:
        _LIMIT.reset(token)


_SHORT, _SHORT_S = 2e8, 2.0
"""Work of less than about a second, and seconds within which it comes to its end."""


@cache
def _pool(n: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n, thread_name_prefix="memcomp-solver")


# Threads do not survive a fork: a child process makes its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


@cache
def forget_outdated(kernel: Any, inlined: tuple[ModuleType, ...]) -> None:
    """Delete compiled code on disk that is older than a module whose functions it contains.

    Numba compiles a function anew when its own file changes, but not when that of an inlined function does.
    """
    if kernel.stats.cache_path is None or not inlined:
        return
    folder, name = Path(kernel.stats.cache_path), kernel.py_func.__module__.rpartition(".")[2]
    newest = max(Path(str(module.__file__)).stat().st_mtime for module in inlined)
    for index in folder.glob(f"{name}.*.nbi"):
        with suppress(FileNotFoundError):  # another process was first
            if index.stat().st_mtime < newest:
                index.unlink()
