"""Minima that are proven at once, and lower bounds that cost little."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.arrays import Array, alike, cast, to_numpy
from memcomp_lightning.problems.maxsat import WeightedMaxSat
from memcomp_lightning.problems.qubo import Qubo

Bits = NDArray[np.bool_]


def eliminated(qubo: Qubo) -> Bits | None:
    r"""A state of lowest energy of one problem whose graph comes apart variable by variable; None if it does not.

    A variable with at most two neighbours takes its best value for each of their states, which leaves a problem
    without it: ``min(0, a + b y + c z)`` is a quadratic form of y and z. So trees, rings and ladders are solved,
    and all other graphs of treewidth two. Integers are added up without rounding.

    Returns:
        ``(n,)``, or None.
    """
    n, coupling = qubo.n, to_numpy(qubo.coupling).ravel()
    used = coupling.nonzero()[0]
    if len(used) > max(0, 2 * n - 3):
        return None  # more pairs than treewidth two allows
    own = to_numpy(qubo.linear).tolist()
    around: list[dict[int, float]] = [{} for _ in range(n)]
    for (i, j), q in zip(to_numpy(qubo.graph.edges())[used].tolist(), coupling[used].tolist(), strict=True):
        around[i][j] = around[j][i] = around[i].get(j, 0) + q  # a pair may be listed twice
    order = list[tuple[int, float, list[tuple[int, float]]]]()
    waiting, done = [i for i in range(n) if len(around[i]) <= 2], [False] * n
    while waiting:
        i = waiting.pop()
        if done[i]:
            continue
        done[i], a = True, own[i]
        near = list(around[i].items())
        order.append((i, a, near))
        rest = min(0, a)
        for j, q in near:
            del around[j][i]
            own[j] += min(0, a + q) - rest
        if len(near) == 2:
            (y, b), (z, c) = near
            both = min(0, a + b + c) - min(0, a + b) - min(0, a + c) + rest
            around[y][z] = around[z][y] = around[y].get(z, 0) + both
        waiting += [j for j, _ in near if len(around[j]) <= 2]
    if len(order) < n:
        return None
    x = [False] * n
    for i, a, near in reversed(order):
        x[i] = a + sum(q for j, q in near if x[j]) < 0
    return np.array(x, np.bool_)


class RoofDual(NamedTuple):
    """The roof dual of a problem.

    Attributes:
        lower_bound: No state has a lower energy.
        minimum: A state of this energy ``(n,)``, where the roof dual decides all variables and meets its bound.
    """

    lower_bound: float
    minimum: Bits | None


MOST_PAIRS = 200_000
"""Couplings up to which a roof dual takes less than half a second."""

MOST_A_VARIABLE = 10
"""Couplings a variable beyond which the bound is so weak that it is not worth importing a package for."""


def roof_dual(qubo: Qubo) -> RoofDual | None:
    """The lower bound of one problem by roof duality; None where it is weak, takes long or its package is missing.

    A maximum flow gives the bound (Boros & Hammer 2002), dwave-preprocessing the flow.
    """
    if math.prod(qubo.graph.edge_shape) > min(MOST_PAIRS, MOST_A_VARIABLE * qubo.n):
        return None
    try:
        from dwave.preprocessing import roof_duality

        from memcomp_lightning.problems.bqm import to_bqm
    except ModuleNotFoundError:  # the extra [dimod] is not installed
        return None
    bound, fixed = roof_duality(to_bqm(qubo), strict=False)
    error, minimum = rounding(parts_of(qubo)), None
    if len(fixed) == qubo.n:
        minimum = np.array([fixed[i] for i in range(qubo.n)], np.bool_)
        x = cast(alike(minimum[None], qubo.linear), qubo.linear.dtype)
        if float(qubo.energy(x)[0]) > bound + 2 * error:  # values of separate parts need not suit each other
            minimum = None
    return RoofDual(float(bound) - error, minimum)


def parts_of(problem: Qubo | WeightedMaxSat) -> list[Array]:
    """The arrays of its numbers."""
    if isinstance(problem, Qubo):
        return [problem.coupling, problem.linear, problem.offset]
    return [problem.weight, problem.unit, problem.offset, *(block.weight for block in problem.longer)]


def rounding(numbers: Sequence[Array]) -> float:
    """Bound on the rounding of a sum of them in float64."""
    return 2.0**-48 * sum(float(abs(part).sum()) for part in numbers)
