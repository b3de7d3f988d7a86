r"""Groups of variables of which exactly one is 1, for solvers that know no constraints.

The energy :math:`t_g (\sum_{i \in g} x_i - 1)` of any number t is zero where the constraint of group g holds. t is
chosen, from states of low energy, halfway between the cost of a second variable at 1 and the gain by the one there
is: then a small penalty :math:`P_g (\sum x_i - 1)^2` suffices, and it hides the least of the objective.
"""

import math
from itertools import count
from typing import TYPE_CHECKING

import numpy as np

from memcomp_lightning import rng
from memcomp_lightning.arrays import Array, alike, cast, double, namespace, to_numpy
from memcomp_lightning.problems.constrained import Constrained, Constraints
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.problems.rows import Integers
from memcomp_lightning.solvers.compiled import Numbers

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator

N_GUIDES = 64
"""Descents from random states, from which shift and penalties are read."""

MARGIN = 0.1
"""What a penalty exceeds the largest gain by, as a share of the mean cost of a second variable at 1."""


def groups_of(problem: Constrained) -> Integers | None:
    """The variables of each group, ``(n_groups, widest)``, and -1 behind the last one.

    None unless the objective is a QUBO and each constraint asks for exactly one of variables of its own.
    """
    rows = problem.constraints
    one = (rows.lower == 1).all() and (rows.upper == 1).all() and (rows.coefficients == 1).all()
    apart = len(np.unique(rows.variables)) == len(rows.variables) and (rows.lengths > 0).all()
    if not (len(rows) and one and apart and isinstance(problem.objective, Qubo)):
        return None
    return table_of(rows)


def table_of(rows: Constraints) -> Integers:
    """The variables of each row, ``(n_rows, longest)``, and -1 behind the last one."""
    table = np.full((len(rows), rows.lengths.max()), -1)
    table[rows.row, np.arange(len(rows.variables)) - rows.begins[rows.row]] = rows.variables
    return table


def shifted(qubo: Qubo, groups: Integers, x: Array) -> tuple[Qubo, Array]:
    """The problem with the shift of each group, and the penalties, ``(*problems, n_groups)``.

    Args:
        qubo: The problem.
        groups: Variables of each group, ``(n_groups, widest)``; -1 is none.
        x: States of low energy with one variable at 1 in each group, ``(*problems, n_states, n)``.
    """
    xp, table = namespace(qubo.linear), alike(groups, qubo.linear)
    # Energy of the variable at 1 less that at 0: of the one that is on, and of the cheapest other one.
    cost, on, absent = qubo.field(x)[..., table], x[..., table] > 0.5, table < 0
    there = xp.where(on & ~absent, cost, 0.0).sum(-1)
    second = xp.min(xp.where(on | absent, xp.inf, cost), axis=-1)
    second = xp.where(xp.isinf(second), there, second)
    apart = abs(second - there).mean((-2, -1))[..., None]
    # Whole multiples of a power of two: sums of whole numbers stay exact.
    unit = cast(alike(np.exp2(np.frexp(to_numpy(apart))[1] - 10), apart), apart.dtype)
    shift = xp.round(-(there + second).mean(-2) / (2 * unit)) * unit
    needed = xp.max(xp.maximum(there + shift[..., None, :], -second - shift[..., None, :]), axis=-2)
    penalties = xp.ceil((needed.clip(0) + MARGIN * apart) / unit + 0.5) * unit
    of_group, column = np.nonzero(groups >= 0)
    linear = xp.asarray(qubo.linear, copy=True)
    linear[..., alike(groups[of_group, column], linear)] += shift[..., alike(of_group, linear)]
    return Qubo(qubo.graph, qubo.coupling, linear, qubo.offset - shift.sum(-1)), penalties


def guides(qubo: Qubo, groups: Integers, generator: "Generator") -> Array:
    """States of low energy with one variable at 1 in each group, ``(*problems, N_GUIDES, n)``."""
    draws = rng.uniform((*qubo.problems, N_GUIDES, qubo.n), generator=generator, like=qubo.linear)
    u = to_numpy(draws)
    x = u < 0.5
    chosen = np.where(groups < 0, -1.0, u[..., groups]).argmax(-1)
    x[..., groups[groups >= 0]] = False
    np.put_along_axis(x, groups[np.arange(len(groups)), chosen], True, axis=-1)
    return descend(qubo, groups, cast(alike(x, qubo.linear), qubo.linear.dtype))


def descend(qubo: Qubo, groups: Integers, x: Array) -> Array:
    """Set one group or one other variable after the other to its cheapest state, until no energy falls.

    Args:
        qubo: The problem.
        groups: Variables of each group, ``(n_groups, widest)``; -1 is none.
        x: States with one variable at 1 in each group, ``(*problems, n_states, n)``.
    """
    n, pairs, sites = qubo.n, to_numpy(qubo.graph.edges()), _sites(qubo.n, groups)
    site_of = np.empty(n + 1, np.int64)
    site_of[sites] = np.arange(len(sites))[:, None]
    across = site_of[pairs[:, 0]] != site_of[pairs[:, 1]]  # in a group there is nothing to couple
    pairs = pairs[across]
    classes = [sites[members] for members in _classes(site_of[pairs], len(sites))]
    n_problems = math.prod(qubo.problems)
    coupling = to_numpy(double(qubo.coupling)).reshape(n_problems, len(across))[:, across]
    linear = to_numpy(double(qubo.linear)).reshape(n_problems, n)
    states = to_numpy(x).reshape(n_problems, *x.shape[-2:])
    found = [_descended(classes, pairs, *numbers) for numbers in zip(coupling, linear, states, strict=True)]
    return cast(alike(np.stack(found).reshape(x.shape), x), x.dtype)


def _sites(n: int, groups: Integers) -> Integers:
    """Variables of each group, then the other ones, each beside n: that stands for its being 0."""
    others = np.setdiff1d(np.arange(n), groups)
    sites = np.full((len(groups) + len(others), max(2, groups.shape[1])), -1)
    sites[: len(groups), : groups.shape[1]] = groups
    sites[len(groups) :, 0], sites[len(groups) :, 1] = others, n
    return sites


def _classes(pairs: Integers, n: int) -> list[Integers]:
    """Sites of which no two are coupled, greedily."""
    neighbours: list[list[int]] = [[] for _ in range(n)]
    low, high = np.sort(pairs, axis=1).T
    for key in np.unique(high * n + low).tolist():
        neighbours[key // n].append(key % n)
    class_of: list[int] = []
    for earlier in neighbours:
        taken = {class_of[other] for other in earlier}
        class_of.append(next(k for k in count() if k not in taken))
    return [np.flatnonzero(np.array(class_of) == k) for k in range(max(class_of) + 1)]


def _descended(
    classes: list[Integers], pairs: Integers, coupling: Numbers, linear: Numbers, states: Numbers
) -> Numbers:
    """Of one problem."""
    from scipy.sparse import coo_array

    size, ends = len(linear) + 1, np.concatenate((pairs, pairs[:, ::-1])).T
    matrix = coo_array((np.tile(coupling, 2), tuple(ends)), shape=(size, size)).tocsr()
    x = np.concatenate((states, np.full((len(states), 1), 0.5)), axis=1)
    field, least = np.append(linear, 0.0) + x @ matrix, 1e-9 * abs(np.append(linear, coupling)).max()
    parts, moving = [(sites, matrix[sites.ravel()]) for sites in classes], True
    while moving:
        moving = False
        for sites, rows in parts:
            cost, now = np.where(sites < 0, np.inf, field[:, sites]), x[:, sites].argmax(-1)[..., None]
            best = cost.argmin(-1)[..., None]
            gain = np.take_along_axis(cost, now, -1) - np.take_along_axis(cost, best, -1)
            change = np.zeros(cost.shape)
            np.put_along_axis(change, best, gain > least, -1)
            change -= np.take_along_axis(change, best, -1) * (np.arange(cost.shape[-1]) == now)
            if change.any():
                moving = True
                x[:, sites] += change
                x[:, -1] = 0.5
                field += change.reshape(len(x), -1) @ rows
    return x[:, :-1]
