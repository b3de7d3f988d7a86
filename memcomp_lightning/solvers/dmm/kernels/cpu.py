"""The compiled kernels: hand arrays to numba and share the restarts among threads."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.compiling import announce_compilation
from memcomp_lightning.problems.graph import Bipartite
from memcomp_lightning.problems.maxsat import WeightedMaxSat
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.compiled import Numbers, float32, forget_outdated, share
from memcomp_lightning.solvers.dmm.base import Recording
from memcomp_lightning.solvers.dmm.bond import BondField
from memcomp_lightning.solvers.dmm.clause import ClauseField
from memcomp_lightning.solvers.dmm.integrate import Splitting
from memcomp_lightning.solvers.dmm.kernels import common, digital, lanes, rows
from memcomp_lightning.solvers.dmm.kernels.common import BOND
from memcomp_lightning.solvers.dmm.kernels.fields import FIELDS
from memcomp_lightning.solvers.dmm.kernels.hand_over import (
    Steps,
    constants_of,
    control_of,
    finish,
    outputs,
    sparse_of,
    steps_of,
)
from memcomp_lightning.solvers.dmm.kernels.prepare import prepare
from memcomp_lightning.solvers.dmm.kernels.run import Run, Stall, Start

announce_compilation()

_INLINED = (common, digital, lanes)
"""Modules whose functions become part of kernels that are kept on disk: those of other packages do not."""


def run(
    field: Any,
    integrator: Splitting,
    problem: Qubo | WeightedMaxSat,
    start: Start,
    *,
    n_steps: int,
    quench_every: int,
    recording: Recording | None,
    stall: Stall | None = None,
    remember: bool = True,
) -> Run:
    """Do what ``reference.run`` does, on the CPU and in float32."""
    steps = steps_of(n_steps, quench_every, recording, stall)
    in_rows = isinstance(field, ClauseField | BondField)
    if in_rows and isinstance(problem, Qubo) and isinstance(problem.graph, Bipartite):
        return _run_rows(field, integrator, problem, problem.graph, start, steps, remember)
    return _run_lanes(field, integrator, problem, start, steps, remember)


def _run_rows(
    field: Any,
    integrator: Splitting,
    problem: Qubo,
    graph: Bipartite,
    start: Start,
    steps: Steps,
    remember: bool,
) -> Run:
    """Two fully coupled layers, one task a restart."""
    n_problems, n_restarts, n = start.voltage.shape
    padded = _prepared(field, problem, graph)
    width, height, n_first, n_second = padded.sizes
    stability, pull_scale, degree = padded.scalars.T
    of_problem = {"pull_scale": pull_scale}
    if isinstance(field, ClauseField):
        of_problem = {"long_term_max": field.most_long_term(degree)}
    constants = constants_of(field, common.CONSTANTS, n_problems, of_problem)
    control = control_of(field, integrator, stability)
    # The kernel divides the sum of the squared rates by the number of variables with the padding.
    control[:, common.CHANGE] *= np.sqrt(n / (width + height))
    voltage = _pad(float32(start.voltage), n_first, width, width + height)
    kept: list[Numbers] = [float32(memory) for memory in start.kept]
    if kept:
        matrix = np.zeros((n_problems, n_restarts, padded.weight.shape[1]), np.float32)
        flat = _pad(kept[0].reshape(n_problems, n_restarts * n_second, n_first), n_first, width, width)
        matrix[..., : n_second * width] = flat.reshape(n_problems, n_restarts, n_second * width)
        kept = [matrix, _pad(kept[1], n_first, width, width + height)]
    else:
        n_kept, sizes = n_restarts if remember else 0, (padded.weight.shape[1], width + height)
        kept = [np.zeros((n_problems, n_kept, size), np.float32) for size in sizes]
    arrays = (padded.kind, padded.sizes, padded.side, constants, *padded[4:])
    out = outputs((n_problems, n_restarts), width + height, steps)
    state = (voltage, *kept, to_numpy(start.seed).astype(np.uint64))
    work = padded.weight.size * n_restarts * steps[0]
    share(rows.integrate_all, n_problems * n_restarts, work, (arrays, control, state, steps, *out), _INLINED)

    def unpad(x: Numbers) -> Numbers:
        return np.concatenate((x[..., :n_first], x[..., width : width + n_second]), axis=-1)

    memories = []
    if remember:
        of_pairs = kept[0][..., : n_second * width].reshape(n_problems, n_restarts, n_second, width)
        memories = [np.ascontiguousarray(of_pairs[..., :n_first]), unpad(kept[1])]
    return finish((unpad(out[0]), *out[1:4], unpad(out[4])), unpad(voltage), memories, steps, start.voltage)


def _pad(x: Numbers, n_first: int, width: int, size: int) -> Numbers:
    """Move what is behind ``n_first`` on the last axis to behind ``width``; zeros elsewhere."""
    padded = np.zeros((*x.shape[:-1], size), np.float32)
    padded[..., :n_first] = x[..., :n_first]
    padded[..., width : width + x.shape[-1] - n_first] = x[..., n_first:]
    return padded


class _Prepared(NamedTuple):
    """Two fully coupled layers as the rows kernel reads them; ``prepare`` says what the arrays are."""

    kind: int
    sizes: tuple[int, int, int, int]
    side: Numbers
    scalars: Numbers
    weight: Numbers
    unit: Numbers
    coupling: Numbers
    transposed: Numbers
    linear: Numbers


def _prepared(field: Any, problem: Qubo, graph: Bipartite) -> _Prepared:
    """Scale problems into the machine's units and into those of the digital state; pad the layers."""
    n_problems, n_first, n_second = problem.offset.shape[0], graph.n_first, graph.n_second
    width, height = (-(-n // _VECTOR) * _VECTOR for n in (n_first, n_second))
    weight = np.zeros((n_problems, (n_second + n_second % 2) * width), np.float32)
    coupling, transposed = (np.zeros((n_problems, height * width), np.float32) for _ in range(2))
    unit, linear = (np.zeros((n_problems, width + height), np.float32) for _ in range(2))
    scalars = np.empty((n_problems, 3))
    kind = BOND if isinstance(field, BondField) else 1 - BOND
    given = [np.ascontiguousarray(to_numpy(x), np.float64) for x in (problem.coupling, problem.linear)]
    forget_outdated(prepare, _INLINED)
    compiled: Any = prepare
    compiled(kind, width, height, *given, weight, unit, scalars, coupling, transposed, linear)
    side = np.where(2 * np.arange(width) < n_first, np.float32(0.5), np.float32(-0.5))
    sizes = (width, height, n_first, n_second)
    return _Prepared(kind, sizes, side, scalars, weight, unit, coupling, transposed, linear)


def _run_lanes(
    field: Any,
    integrator: Splitting,
    problem: Qubo | WeightedMaxSat,
    start: Start,
    steps: Steps,
    remember: bool,
) -> Run:
    """Listed pairs and longer clauses, one task a block of restarts; idle lanes repeat the first restarts."""
    passes, machine = FIELDS[type(field)], field.build(problem)
    constants = constants_of(field, passes.constants, len(start.voltage), passes.of_problem(field, machine))
    control = control_of(field, integrator, float32(field.stability(machine)).reshape(-1))
    n_problems, n_restarts, n = start.voltage.shape
    n_blocks, lanes_each = _blocks(n_restarts)
    sparse = sparse_of(passes.listed(machine), problem, n_problems)
    voltage = _to_lanes(float32(start.voltage), n_blocks, lanes_each)
    # Arrays of numpy lie in huge pages where they can.
    memories = [
        np.zeros((n_problems, n_blocks, *shape, lanes_each), np.float32)
        for shape in ((2, sparse.weight.shape[1]), (n,), (2, sparse.longer_weight.shape[1]))
    ]
    long = [memories[0][:, :, 1], memories[1], memories[2][:, :, 1]]
    for memory, kept in zip(long, start.kept, strict=False):
        memory[:] = _to_lanes(float32(kept), n_blocks, lanes_each)
    seed = np.ascontiguousarray(
        _to_lanes(to_numpy(start.seed).astype(np.uint64)[..., None], n_blocks, lanes_each)[:, :, 0]
    )
    best, *out = outputs((n_problems, n_blocks, lanes_each), n, steps)
    best = np.zeros((n_problems, n_blocks, n, lanes_each), np.float32)
    longer = (sparse.variables, sparse.longer_polarity, sparse.longer_weight)
    own = (passes.kind, constants, sparse.pairs, sparse.weight, sparse.polarity, sparse.unit)
    arrays = (*own, longer, sparse.digital, sparse.linear)
    state = (voltage, *memories, seed)
    work = (sparse.weight.size + sparse.longer_weight.size) * n_restarts * steps[0]
    ours = type(passes.kind).__module__.startswith("memcomp_lightning.")
    kernel = lanes.integrate_all if ours else _of_this_process()
    share(kernel, n_problems * n_blocks, work, (arrays, control, state, steps, best, *out), _INLINED)
    out = [x.reshape(n_problems, n_blocks * lanes_each, *x.shape[3:])[:, :n_restarts] for x in out]
    best, final, *remembered = (_from_lanes(x, n_restarts) for x in (best, voltage, *(long if remember else ())))
    return finish((best, *out), final, remembered, steps, start.voltage)


@cache
def _of_this_process() -> Any:
    """The kernel for fields of other packages; on disk it would name types that other processes may not find."""
    return njit(nogil=True)(lanes.integrate_all.py_func)


def _blocks(n_restarts: int) -> tuple[int, int]:
    """Number of blocks of restarts and lanes of each: 4, 8 or 16."""
    lanes_each = next((few for few in (4, 8) if n_restarts <= few), 16)
    return -(-n_restarts // lanes_each), lanes_each


_VECTOR = 16
"""float32 numbers in the widest vector registers; layers are padded to a multiple."""


def _to_lanes(x: Numbers, n_blocks: int, lanes_each: int) -> Numbers:
    """``(n_problems, n_restarts, size)`` as ``(n_problems, n_blocks, size, lanes_each)``."""
    restart = np.arange(n_blocks * lanes_each) % x.shape[1]
    blocks = x[:, restart].reshape(x.shape[0], n_blocks, lanes_each, x.shape[2])
    return np.ascontiguousarray(blocks.transpose(0, 1, 3, 2))


def _from_lanes(x: Numbers, n_restarts: int) -> Numbers:
    """The inverse of :func:`_to_lanes`."""
    flat = x.transpose(0, 1, 3, 2).reshape(x.shape[0], x.shape[1] * x.shape[3], x.shape[2])
    return np.ascontiguousarray(flat[:, :n_restarts])
