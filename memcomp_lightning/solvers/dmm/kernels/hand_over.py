"""Hand problems over to compiled kernels as arrays of numpy, and take back what they return."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from memcomp_lightning.arrays import Array, alike, to_numpy
from memcomp_lightning.problems.maxsat import WeightedMaxSat, to_qubo
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.compiled import Numbers, float32, grouped, over, power_of_two
from memcomp_lightning.solvers.dmm.base import Recording
from memcomp_lightning.solvers.dmm.integrate import Splitting
from memcomp_lightning.solvers.dmm.kernels import common
from memcomp_lightning.solvers.dmm.kernels.fields import Listed
from memcomp_lightning.solvers.dmm.kernels.run import Run, Stall, Visited

Steps = tuple[int, int, int, int, float]
"""(n_steps, quench_every, record_every, min_steps, stall), as the kernels explain them; record_every 0 is none."""


def steps_of(n_steps: int, quench_every: int, recording: Recording | None, stall: Stall | None) -> Steps:
    """How the kernels are told of steps; a recorded restart does not stall."""
    every = recording.every if recording is not None else 0
    min_steps, factor = (n_steps, 0.0) if stall is None or every else stall
    return n_steps, quench_every, every, min_steps, float(factor)


class Sparse(NamedTuple):
    """A problem as the kernels for listed pairs read it."""

    pairs: Numbers
    weight: Numbers
    polarity: Numbers
    unit: Numbers
    variables: Numbers
    longer_polarity: Numbers
    longer_weight: Numbers
    digital: tuple[Numbers, ...]
    linear: Numbers


def sparse_of(listed: Listed, problem: Qubo | WeightedMaxSat, n_problems: int) -> Sparse:
    """Flatten a problem and list, for each variable, its pairs and its longer clauses."""
    pairs = np.ascontiguousarray(to_numpy(problem.graph.edges()))
    n, n_pairs = problem.n, pairs.shape[0]
    polarity = np.zeros((n_problems, n_pairs, 2), np.float32)
    if listed.polarity is not None:
        polarity = float32(listed.polarity)
    variables, longer_polarity = np.zeros((0, 3), np.int64), np.zeros((0, 3), np.float32)
    longer_weight = np.zeros((n_problems, 0), np.float32)
    if listed.longer is not None:
        variables = to_numpy(listed.longer[0])
        longer_polarity, longer_weight = (float32(x) for x in listed.longer[1:])
    if isinstance(problem, Qubo):
        quadratic, block_weights = problem, []
    else:
        quadratic = to_qubo(problem.without_longer())
        block_weights = [block.weight for block in problem.longer]
    weights = np.concatenate([to_numpy(block) for block in block_weights or [quadratic.linear[:, :0]]], axis=-1)
    parts = (quadratic.coupling.reshape(n_problems, n_pairs), quadratic.linear, weights)
    coupling, linear, clause_weight = (over(part, power_of_two(*parts)) for part in parts)
    ends = np.concatenate((pairs[:, 0], pairs[:, 1]))
    order, offsets = grouped(ends, n)
    neighbours = np.concatenate((pairs[:, 1], pairs[:, 0]))[order]
    literal_clause, literal_at = np.nonzero(longer_polarity)
    clause_order, clause_offsets = grouped(variables[literal_clause, literal_at], n)
    of_pairs = (offsets, neighbours.astype(np.int32), np.ascontiguousarray(np.tile(coupling, 2)[:, order]))
    of_clauses = (clause_offsets, literal_clause[clause_order], clause_weight)
    return Sparse(
        pairs.astype(np.int32),
        float32(listed.weight.reshape(n_problems, n_pairs)),
        polarity,
        float32(listed.unit.reshape(n_problems, n)),
        variables,
        longer_polarity,
        longer_weight,
        (*of_pairs, *of_clauses),
        linear,
    )


def constants_of(field: Any, names: Sequence[str], n_problems: int, of_problem: Mapping[str, Any]) -> Numbers:
    """Settings of the field as its passes read them, a row a problem; 0 where the field has none of a name."""
    constants = np.zeros((n_problems, len(names)), np.float32)
    for index, name in enumerate(names):
        value = of_problem[name] if name in of_problem else getattr(field, name, 0.0)
        constants[:, index] = np.asarray(value).reshape(-1)
    return constants


def control_of(field: Any, integrator: Splitting, stability: Numbers) -> Numbers:
    """The step control as the kernels read it, a row a problem."""
    limits = (integrator.change, integrator.dt_min, integrator.dt_max, field.noise, integrator.lag)
    control = np.tile(np.array(limits, np.float32), (len(stability), 1))
    control[:, common.CHANGE] *= stability
    return control


def outputs(restarts: tuple[int, ...], n: int, steps: Steps) -> tuple[Numbers, ...]:
    """Best assignment, its step, the last step, record times and states."""
    n_records = steps[0] // steps[2] if steps[2] else 0
    return (
        np.empty((*restarts, n), np.float32),
        np.empty(restarts, np.int64),
        np.empty(restarts, np.int64),
        np.empty((*restarts, n_records)),
        np.empty((*restarts, n_records, n), np.bool_),
    )


def finish(out: tuple[Numbers, ...], voltage: Numbers, memories: list[Numbers], steps: Steps, like: Array) -> Run:
    """The outcome as arrays of the library of the start."""
    best, found_at, last, times, states = (alike(np.ascontiguousarray(x), like) for x in out)
    kept = tuple(alike(memory, like) for memory in memories)
    visited = Visited(times, states) if steps[2] else None
    return Run(best > 0.5, found_at, last, alike(voltage, like), kept, visited)
