"""The compiled kernels: hand tensors to numba and share the restarts among threads."""

import logging
import os
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning.dmm.base import Recording
from memcomp_lightning.dmm.bond import BondField, BondMachine
from memcomp_lightning.dmm.clause import ClauseField, ClauseMachine
from memcomp_lightning.dmm.integrate import Splitting
from memcomp_lightning.dmm.kernels import lanes, rows
from memcomp_lightning.dmm.kernels.common import BOND
from memcomp_lightning.dmm.kernels.run import Run, Start, Visited
from memcomp_lightning.qubo.graph import Bipartite
from memcomp_lightning.qubo.maxsat import WeightedMaxSat, to_qubo
from memcomp_lightning.qubo.qubo import Qubo

log = logging.getLogger(__name__)

Array = np.ndarray[Any, Any]
Machine = ClauseMachine | BondMachine


def run(
    field: ClauseField | BondField,
    integrator: Splitting,
    problem: Qubo | WeightedMaxSat,
    start: Start,
    *,
    n_steps: int,
    quench_every: int,
    recording: Recording | None,
) -> Run:
    """Do what ``reference.run`` does, for tensors on the CPU, in float32."""
    steps = (n_steps, quench_every, recording.every if recording is not None else 0)
    machine: Any = field.build(problem)
    limits = np.array([integrator.max_change, integrator.dt_min, integrator.dt_max, field.noise], np.float32)
    control = np.tile(limits, (start.voltage.shape[0], 1))
    control[:, 0] *= _array(field.stability(machine)).reshape(-1)
    constants = _constants(field, machine, start.voltage.shape[0])
    if isinstance(problem, Qubo) and isinstance(problem.graph, Bipartite):
        return _run_rows(machine, problem, constants, control, start, steps)
    return _run_lanes(machine, problem, constants, control, start, steps)


def _run_rows(
    machine: Machine, problem: Qubo, constants: Array, control: Array, start: Start, steps: tuple[int, int, int]
) -> Run:
    """Two fully coupled layers, one task a restart."""
    n_problems, n_restarts, n = start.voltage.shape
    if isinstance(machine, BondMachine):
        kind, weight, unit = BOND, machine.bond, machine.field
    else:
        kind, weight, unit = 1 - BOND, machine.first * machine.weight, machine.unit
    coupling, linear = _digital(problem.coupling, problem.linear)
    transposed = np.ascontiguousarray(np.swapaxes(coupling, -1, -2))
    arrays = (kind, constants, _array(weight.squeeze(-3)), _array(unit.squeeze(-2)), coupling, transposed, linear)
    voltage = _array(start.voltage).copy()
    memories = _memories(((*voltage.shape[:2], *coupling.shape[1:]), voltage.shape), start.kept)
    out = _outputs((n_problems, n_restarts), n, steps)
    state = (voltage, *memories, _seeds(start.seed))
    work = coupling.size * n_restarts * steps[0]
    _share(rows.integrate_all, n_problems * n_restarts, work, (arrays, control, state, steps, *out))
    return _finish(out, voltage, memories, steps)


def _run_lanes(
    machine: Machine,
    problem: Qubo | WeightedMaxSat,
    constants: Array,
    control: Array,
    start: Start,
    steps: tuple[int, int, int],
) -> Run:
    """Listed pairs and longer clauses, one task a block of restarts; idle lanes repeat the first restarts."""
    n_problems, n_restarts, n = start.voltage.shape
    n_blocks, lanes_each = _blocks(n_restarts)
    sparse = _sparse(machine, problem, n_problems)
    voltage = _to_lanes(_array(start.voltage), n_blocks, lanes_each)
    sizes = (sparse.weight.shape[1], n, sparse.longer_weight.shape[1])
    memories = [
        _to_lanes(memory, n_blocks, lanes_each)
        for memory in _memories([(n_problems, n_restarts, size) for size in sizes], start.kept)
    ]
    seed = np.ascontiguousarray(_to_lanes(_seeds(start.seed)[..., None], n_blocks, lanes_each)[:, :, 0])
    out = _outputs((n_problems, n_blocks, lanes_each), n, steps)
    longer = (sparse.variables, sparse.longer_polarity, sparse.longer_weight)
    own = (sparse.kind, constants, sparse.pairs, sparse.weight, sparse.polarity, sparse.unit)
    arrays = (*own, longer, sparse.digital, sparse.linear)
    state = (voltage, *memories, seed)
    work = (sparse.weight.size + sparse.longer_weight.size) * n_restarts * steps[0]
    _share(lanes.integrate_all, n_problems * n_blocks, work, (arrays, control, state, steps, *out))
    out = tuple(x.reshape(n_problems, n_blocks * lanes_each, *x.shape[3:])[:, :n_restarts] for x in out)
    final = [_from_lanes(x, n_restarts) for x in (voltage, *memories)]
    return _finish(out, final[0], final[1:], steps)


class _Sparse(NamedTuple):
    """A problem as the lanes kernel reads it."""

    kind: int
    pairs: Array
    weight: Array
    polarity: Array
    unit: Array
    variables: Array
    longer_polarity: Array
    longer_weight: Array
    digital: tuple[Array, ...]
    linear: Array


def _sparse(machine: Machine, problem: Qubo | WeightedMaxSat, n_problems: int) -> _Sparse:
    """Flatten a problem and list, for each variable, its pairs and its longer clauses."""
    pairs = np.ascontiguousarray(problem.graph.edges().cpu().numpy())
    n, n_pairs = problem.n, pairs.shape[0]
    if isinstance(machine, BondMachine):
        kind, weight, unit = BOND, machine.bond, machine.field
        polarity = np.zeros((n_problems, n_pairs, 2), np.float32)
        variables, longer_polarity = np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32)
        longer_weight = np.zeros((n_problems, 0), np.float32)
    else:
        kind, weight, unit = 1 - BOND, machine.weight, machine.unit
        both = [q.expand(weight.shape).reshape(n_problems, n_pairs) for q in (machine.first, machine.second)]
        polarity = _array(torch.stack(both, dim=-1))
        variables, longer_polarity = machine.longer_variables.numpy(), _array(machine.longer_polarity)
        longer_weight = _array(machine.longer_weight.squeeze(-2))
    if isinstance(problem, Qubo):
        quadratic, block_weights = problem, []
    else:
        quadratic = to_qubo(problem.without_longer())
        block_weights = [block.weight for block in problem.longer]
    coupling, linear, clause_weight = _digital(
        quadratic.coupling.reshape(n_problems, n_pairs),
        quadratic.linear,
        torch.cat(block_weights or [quadratic.linear[:, :0]], dim=-1),
    )
    ends = np.concatenate((pairs[:, 0], pairs[:, 1]))
    order, offsets = _sorted(ends, n)
    neighbours = np.concatenate((pairs[:, 1], pairs[:, 0]))[order]
    literal_clause, literal_at = np.nonzero(longer_polarity)
    clause_order, clause_offsets = _sorted(variables[literal_clause, literal_at], n)
    of_pairs = (offsets, neighbours, order % max(n_pairs, 1), coupling)
    of_clauses = (clause_offsets, literal_clause[clause_order], clause_weight)
    return _Sparse(
        kind,
        pairs,
        _array(weight.reshape(n_problems, n_pairs)),
        polarity,
        _array(unit.squeeze(-2)),
        variables,
        longer_polarity,
        longer_weight,
        (*of_pairs, *of_clauses),
        linear,
    )


def _sorted(variable: Array, n: int) -> tuple[Array, Array]:
    """Order that groups entries by variable, and where each variable's group begins, ``(n + 1,)``."""
    counts = np.bincount(variable, minlength=n)
    return np.argsort(variable, kind="stable"), np.concatenate(([0], np.cumsum(counts)))


def _constants(field: ClauseField | BondField, machine: Machine, n_problems: int) -> Array:
    """Constants of the field in the order in which the kernels read them, ``(n_problems, 10)``."""
    if isinstance(field, BondField):
        values = [field.alpha, field.beta, field.gamma, field.kappa, field.delta, field.zeta]
        values += [field.short_term_min, field.long_term_max, field.short_term_start, 1.0]
    else:
        values = [field.alpha, field.beta, field.gamma, field.delta, field.epsilon, field.zeta]
        values += [field.long_term_max, field.unit_pull, 0.0, 1.0]
    constants = np.tile(np.array(values, np.float32), (n_problems, 1))
    if isinstance(machine, BondMachine):
        constants[:, 9] = _array(machine.pull_scale).reshape(-1)
    return constants


def _digital(*parts: Tensor) -> tuple[Array, ...]:
    """Parts of the energy over a power of two a problem, so that float32 holds them and integers stay exact."""
    sizes = [part.abs().flatten(1).double() for part in parts if part.numel()]
    largest = torch.stack([size.amax(1) for size in sizes]).amax(0)
    scale = torch.exp2(torch.frexp(largest.clamp(min=1e-300)).exponent.double())
    return tuple(_array(part / scale.reshape(-1, *(1,) * (part.ndim - 1))) for part in parts)


def _array(x: Tensor) -> Array:
    """A tensor as a contiguous float32 array."""
    return np.ascontiguousarray(x.detach().to(torch.float32).numpy())


def _seeds(seed: Tensor) -> Array:
    return seed.numpy().astype(np.uint64)


def _memories(shapes: Any, kept: tuple[Tensor, ...]) -> list[Array]:
    """Long-term memories: as kept, or at rest."""
    if kept:
        return [_array(memory).copy() for memory in kept]
    return [np.zeros(shape, np.float32) for shape in shapes]


def _outputs(restarts: tuple[int, ...], n: int, steps: tuple[int, int, int]) -> tuple[Array, ...]:
    """Best assignment, its step, record times and states."""
    n_records = steps[0] // steps[2] if steps[2] else 0
    return (
        np.empty((*restarts, n), np.float32),
        np.empty(restarts, np.int64),
        np.empty((*restarts, n_records)),
        np.empty((*restarts, n_records, n), np.bool_),
    )


def _finish(out: tuple[Array, ...], voltage: Array, memories: list[Array], steps: tuple[int, int, int]) -> Run:
    best, found_at, times, states = (torch.from_numpy(np.ascontiguousarray(x)) for x in out)
    kept = tuple(torch.from_numpy(memory) for memory in memories)
    visited = Visited(times, states) if steps[2] else None
    return Run(best > 0.5, found_at, torch.from_numpy(voltage), kept, visited)


def _blocks(n_restarts: int) -> tuple[int, int]:
    """Number of blocks of restarts and lanes of each, a multiple of the vector width up to ``_MOST_LANES``."""
    n_blocks = -(-n_restarts // _MOST_LANES)
    return n_blocks, -(-n_restarts // (n_blocks * _VECTOR)) * _VECTOR


_VECTOR = 16
"""float32 numbers in the longest vector register of present processors."""

_MOST_LANES = 32
"""Enough to hide the cost of a loop over the lanes, few enough to keep a variable's numbers close together."""


def _to_lanes(x: Array, n_blocks: int, lanes_each: int) -> Array:
    """``(n_problems, n_restarts, size)`` as ``(n_problems, n_blocks, size, lanes_each)``."""
    restart = np.arange(n_blocks * lanes_each) % x.shape[1]
    blocks = x[:, restart].reshape(x.shape[0], n_blocks, lanes_each, x.shape[2])
    return np.ascontiguousarray(blocks.transpose(0, 1, 3, 2))


def _from_lanes(x: Array, n_restarts: int) -> Array:
    """The inverse of :func:`_to_lanes`."""
    flat = x.transpose(0, 1, 3, 2).reshape(x.shape[0], x.shape[1] * x.shape[3], x.shape[2])
    return np.ascontiguousarray(flat[:, :n_restarts])


@cache
def _pool(n_threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(n_threads, thread_name_prefix="memcomp-dmm")


# Threads do not survive a fork: a child process makes its own.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)


def _share(kernel: Any, n_items: int, work: float, arguments: tuple[Any, ...]) -> None:
    """Run items 0 to ``n_items - 1`` on as many threads as torch uses; ``work`` counts pairs x steps x restarts.

    Compiled code is deaf to Ctrl-C: what takes long runs on threads of its own, which this one tells to stop.
    """
    _announce(kernel)
    stop = np.zeros(1, np.uint8)
    n_threads = min(torch.get_num_threads(), n_items)
    if n_threads <= 1 and work < _SHORT:
        kernel(0, n_items, stop, *arguments)
        return
    if not kernel.signatures:
        kernel(0, 0, stop, *arguments)  # compiles once, not on every thread
    cuts = np.linspace(0, n_items, min(n_items, 4 * n_threads) + 1).astype(int).tolist()
    jobs = [_pool(n_threads).submit(kernel, a, b, stop, *arguments) for a, b in pairwise(cuts)]
    try:
        for job in jobs:
            job.result()
    except BaseException:
        stop[0] = 1
        wait(jobs)
        raise


_SHORT = 2e8
"""Work of less than about a second."""


@cache
def _announce(kernel: Any) -> None:
    """Say once that the first call compiles, if nothing is cached on disk."""
    folder = Path(kernel.stats.cache_path)
    if not any(folder.glob(f"{kernel.py_func.__module__.rpartition('.')[2]}.{kernel.__name__}*.nbi")):
        log.warning("Compiling the DMM kernel for this processor, once (about half a minute); kept in %s", folder)
