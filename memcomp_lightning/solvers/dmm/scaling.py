"""Bring all problems to one scale, so that the same constants suit 32 and 100,000 variables."""

import math

from memcomp_lightning.arrays import Array, double, namespace
from memcomp_lightning.problems.graph import Graph

SMALLEST_RATIO = 1e-12
"""Couplings this much smaller than the largest unit clause or field do not set the scale."""


def by_largest(coupling: Array, linear: Array, n_axes: int) -> tuple[Array, Array]:
    """Divide by the largest entry: squares of 1e-30 or 1e30 would leave the range of float32.

    ``n_axes`` is the number of edge axes of the couplings.
    """
    xp = namespace(linear)
    largest = xp.maximum(amax(abs(coupling), n_axes), xp.max(abs(linear), axis=-1))
    largest = xp.where(largest > 0, largest, 1)
    # In two steps, as the reciprocal of a subnormal number is infinite.
    return coupling / expand(largest, n_axes), linear / largest[..., None]


def coupling_norm(graph: Graph, coupling: Array) -> Array:
    r"""The scale to divide couplings by, so that rates are of order 1, ``(*problems,)``.

    Root mean square over the coupled variables of ``\sqrt{\sum_j w_ij^2}``: a random assignment drives a variable
    with about this strength, whatever the size and the degree. Zero couplings and isolated variables do not change
    it. 1 where nothing is coupled.
    """
    power = coupling * coupling
    return or_one(mean_of_used(graph.scatter(power, power)) ** 0.5)


def mean_of_used(per_variable: Array) -> Array:
    """Mean over the variables whose number is more than 0, ``(*problems,)``; 0 without any."""
    return per_variable.sum(-1) / (per_variable > 0).sum(-1, dtype=per_variable.dtype).clip(min=1)


def or_one(scale: Array) -> Array:
    """1 in place of a scale that is next to nothing."""
    return namespace(scale).where(scale > SMALLEST_RATIO, scale, 1)


def effective_degree(size: Array, power: Array) -> Array:
    r"""Number of couplings that matter to a variable, which bounds the long-term memories, ``(*problems,)``.

    Mean over the coupled variables of ``(\sum_j |w_ij|)^2 / \sum_j w_ij^2``: the number of couplings of a variable
    if all are alike, less if some are stronger. At least 1. The two sums of each variable, ``(*problems, n)``, are
    ``size`` and ``power``.
    """
    where = namespace(power).where
    return mean_of_used(where(power > 0, size * size / where(power > 0, power, 1), 0)).clip(min=1)


DEGREE_EXPONENT = 0.17
"""How the best bound of the long-term memories, less 1, falls with the effective degree."""


def step_scale(n: int, n_coupled: Array) -> Array:
    r"""Factor on a step that suits 200 variables: larger problems want smaller steps (measured), ``(*problems,)``.

    It is ``(n_c / 200)^{-0.3} \sqrt{n_c / n}`` for n variables, n_c of which are coupled. The root corrects for
    those without couplings, which count in the root mean square of the rates, too.
    """
    count = double(n_coupled.clip(min=1))
    return (count / 200) ** -SIZE_EXPONENT * (count / n) ** 0.5


SIZE_EXPONENT = 0.3
"""How the best step falls with the number of variables."""


def collective_mode(graph: Graph, coupling: Array) -> Array:
    r"""Factor on couplings of norm 1 that keeps all variables from flipping together, ``(*problems,)``.

    It is ``min(1, 2 / \lambda)``, lambda being the largest \|eigenvalue\| of the couplings: about 2 if they are
    independent. Where all variables pull alike, as in MAX-CUT of an unweighted graph, lambda is larger, and steps
    that suit independent couplings would let all variables flip back and forth together: the critical step falls
    with 1 / lambda. Found by power iteration from a fixed start, which is
    orthogonal to no pattern that problems are likely to have.
    """
    xp, problems = namespace(coupling), coupling.shape[: coupling.ndim - len(graph.edge_shape)]
    n = xp.arange(graph.n, device=coupling.device, dtype=coupling.dtype)
    x = xp.broadcast_to(1 + 0.5 * xp.sin(n * n), (*problems, 1, graph.n))
    norm = xp.linalg.vector_norm
    for _ in range(POWER_ITERATIONS):
        x = graph.field(coupling, x)
    before = norm(x, axis=-1)[..., None]
    x = graph.field(coupling, x / before.clip(min=SMALLEST_RATIO))
    largest = norm(x, axis=-1)[..., 0]
    return (2 / largest.clip(min=SMALLEST_RATIO)).clip(max=1)


POWER_ITERATIONS = 5
"""A collective mode stands out of the spectrum: a few iterations find it."""


def mean_strength(graph: Graph, coupling: Array) -> Array:
    r"""Mean over the coupled variables of ``\sum_j |w_ij|``, ``(*problems,)``; 1 where nothing is coupled."""
    size = abs(coupling)
    return or_one(mean_of_used(graph.scatter(size, size)))


def decisive(graph: Graph, coupling: Array, linear: Array) -> Array:
    r"""Limit \|linear_i\| to what surely decides variable i: twice ``\sum_j |w_ij|``, at least 1.

    Without the limit one huge field would set the step size of the whole machine.
    """
    size = abs(coupling)
    limit = (2 * graph.scatter(size, size)).clip(min=1)
    return linear.clip(-limit, limit)


def expand(x: Array, n_axes: int) -> Array:
    """Append axes of size 1."""
    return x.reshape(*x.shape, *(1,) * n_axes)


def amax(x: Array, n_axes: int) -> Array:
    """Maximum over the last axes, 0 where they are empty."""
    axes = tuple(range(-n_axes, 0))
    return namespace(x).max(x, axis=axes) if math.prod(x.shape[axes[0] :]) else x.sum(axes)
