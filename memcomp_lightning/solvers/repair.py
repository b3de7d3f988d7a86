"""Mend broken constraints by flips, then lower the objective by flips that break none."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.arrays import Array, alike, cast, to_numpy
from memcomp_lightning.problems import WeightedMaxSat
from memcomp_lightning.problems.constrained import Constrained, sums_of
from memcomp_lightning.problems.rows import Integers
from memcomp_lightning.solvers.compiled import grouped


def repair(problem: Constrained, x: Array) -> Array:
    """Flip variables of each state until no flip is an improvement; never breaks more constraints.

    A flip improves a state if it mends more constraints than it breaks, or brings the sums nearer to their bounds,
    or lowers the objective, in this order. The cheapest flip of those that mend something comes first. Flips that
    share no constraint, coupling or clause are done at once.

    Args:
        problem: One problem, or several.
        x: States in {0, 1}, ``(*problems, n_states, n)``.
    """
    rows, every = problem.constraints, to_numpy(x) > 0.5
    order, ends = grouped(rows.variables, problem.n)
    around = _Neighbours(problem)
    row, moving = rows.row, np.arange(every.shape[-2])
    while moving.size:
        state = every[..., moving, :]
        sums = rows.sums(state)
        change = np.where(state[..., rows.variables], -rows.coefficients, rows.coefficients)
        before = rows.excess(sums)[..., row]
        after = rows.excess(sums[..., row] + change, row)
        broken = sums_of(((after > 0) * 1 - (before > 0))[..., order], ends)
        excess = sums_of((after - before)[..., order], ends)
        field = to_numpy(problem.objective.field(cast(alike(state, x), x.dtype)))
        costs = np.where(state, -field, field)
        mends = (broken < 0) | ((broken == 0) & (excess < 0))
        lowers = (broken == 0) & (excess == 0) & (costs < -_rounding(costs))
        good = mends | lowers
        price = np.where(mends, costs / np.maximum(-broken, 1), costs)
        every[..., moving, :] ^= good & around.first(np.lexsort((price, ~mends, ~good)))
        moving = moving[good.any(-1).reshape(-1, len(moving)).any(0)]
    return cast(alike(every, x), x.dtype)


def _rounding(costs: NDArray[Any]) -> float:
    """A bound on the rounding of these sums: what changes the objective by less may not change it at all."""
    unit = np.finfo(costs.dtype).eps if costs.dtype.kind == "f" else 0.0
    return float(1000 * unit * np.abs(costs).max(initial=0.0))


class _Neighbours:
    """Which variables share a constraint, a coupling or a clause."""

    def __init__(self, problem: Constrained) -> None:
        rows, objective = problem.constraints, problem.objective
        parts = [(rows.variables, rows.lengths)]
        blocks = [to_numpy(objective.graph.edges())]
        if isinstance(objective, WeightedMaxSat):
            blocks += [to_numpy(block.variables) for block in objective.longer]
        parts += [(block.ravel(), np.full(len(block), block.shape[1])) for block in blocks]
        lengths = np.concatenate([part[1] for part in parts])
        self._variables = np.concatenate([part[0] for part in parts])
        self._group = np.repeat(np.arange(np.count_nonzero(lengths)), lengths[lengths > 0])
        self._begins = np.flatnonzero(np.diff(self._group, prepend=-1))
        self._order, ends = grouped(self._variables, problem.n)
        self._used = np.flatnonzero(np.diff(ends))
        self._ends = ends[self._used]

    def first(self, order: Integers) -> NDArray[np.bool_]:
        """Variables that come before all their neighbours in an order, ``(*leading, n)``."""
        place = np.empty_like(order)
        np.put_along_axis(place, order, np.arange(order.shape[-1]), -1)
        earliest = np.ones(place.shape, np.bool_)
        if len(self._begins):
            lowest = np.minimum.reduceat(place[..., self._variables], self._begins, axis=-1)
            lowest = lowest[..., self._group[self._order]]
            lowest = np.minimum.reduceat(lowest, self._ends, axis=-1)
            earliest[..., self._used] = lowest == place[..., self._used]
        return earliest
