"""Bring all problems to one scale, so that the same constants suit 32 and 100,000 variables."""

import math

import torch
from torch import Tensor

from memcomp_lightning.problems.graph import Graph

SMALLEST_RATIO = 1e-12
"""Couplings this much smaller than the largest unit clause or field do not set the scale."""


def by_largest(coupling: Tensor, linear: Tensor, n_axes: int) -> tuple[Tensor, Tensor]:
    """Divide by the largest entry: squares of 1e-30 or 1e30 would leave the range of float32.

    Args:
        coupling: ``(*problems, *edge_shape)``, ``n_axes`` of them edge axes.
        linear: ``(*problems, n)``.
        n_axes: Number of edge axes.
    """
    largest = torch.maximum(amax(coupling.abs(), n_axes), linear.abs().amax(-1))
    largest = torch.where(largest > 0, largest, torch.ones_like(largest))
    # In two steps, as the reciprocal of a subnormal number is infinite.
    return coupling / expand(largest, n_axes), linear / largest.unsqueeze(-1)


def coupling_norm(graph: Graph, coupling: Tensor) -> Tensor:
    r"""The scale to divide couplings by, so that rates are of order 1, ``(*problems,)``.

    Root mean square over the coupled variables of ``\sqrt{\sum_j w_ij^2}``: a random assignment drives a variable
    with about this strength, whatever the size and the degree. Zero couplings and isolated variables do not change
    it. 1 where nothing is coupled.
    """
    power = coupling.square()
    per_variable = graph.scatter(power, power)
    norm = (per_variable.sum(-1) / (per_variable > 0).sum(-1).clamp(min=1)).sqrt()
    return torch.where(norm > SMALLEST_RATIO, norm, torch.ones_like(norm))


def effective_degree(size: Tensor, power: Tensor) -> Tensor:
    r"""Number of couplings that matter to a variable, which bounds the long-term memories, ``(*problems,)``.

    Mean over the coupled variables of ``(\sum_j |w_ij|)^2 / \sum_j w_ij^2``: the number of couplings of a variable
    if all are alike, less if some are stronger. At least 1.

    Args:
        size: ``\sum_j |w_ij|`` of each variable, ``(*problems, n)``.
        power: ``\sum_j w_ij^2``, likewise.
    """
    used = power > 0
    degree = torch.where(used, size.square() / torch.where(used, power, 1), 0)
    return (degree.sum(-1) / used.sum(-1).clamp(min=1)).clamp(min=1)


DEGREE_EXPONENT = 0.17
"""How the best bound of the long-term memories, less 1, falls with the effective degree."""


def step_scale(n: int, n_coupled: Tensor) -> Tensor:
    r"""Factor on a step that suits 200 variables: larger problems want smaller steps (measured), ``(*problems,)``.

    It is ``(n_c / 200)^{-0.3} \sqrt{n_c / n}``. The root corrects for variables without couplings, which count in
    the root mean square of the rates, too.

    Args:
        n: Number of variables.
        n_coupled: Number n_c of those that are coupled, ``(*problems,)``.
    """
    count = n_coupled.clamp(min=1).double()
    return (count / 200) ** -SIZE_EXPONENT * (count / n).sqrt()


SIZE_EXPONENT = 0.3
"""How the best step falls with the number of variables."""


def collective_mode(graph: Graph, coupling: Tensor) -> Tensor:
    r"""Factor on couplings of norm 1 that keeps all variables from flipping together, ``(*problems,)``.

    It is ``min(1, 2 / \lambda)``, lambda being the largest \|eigenvalue\| of the couplings: about 2 if they are
    independent. Where all variables pull alike, as in MAX-CUT of an unweighted graph, lambda is larger, and steps
    that suit independent couplings would let all variables flip back and forth together: the critical step falls
    with 1 / lambda. Found by power iteration from a fixed start, which is
    orthogonal to no pattern that problems are likely to have.

    Args:
        graph: The pairs.
        coupling: ``(*problems, *edge_shape)``, divided by their :func:`coupling_norm`.
    """
    problems = coupling.shape[: coupling.ndim - len(graph.edge_shape)]
    n = torch.arange(graph.n, device=coupling.device, dtype=coupling.dtype)
    x = (1 + 0.5 * torch.sin(n * n)).expand(*problems, 1, graph.n)
    for _ in range(POWER_ITERATIONS):
        x = graph.field(coupling, x)
    before = x.norm(dim=-1, keepdim=True)
    x = graph.field(coupling, x / before.clamp(min=SMALLEST_RATIO))
    largest = x.norm(dim=-1).squeeze(-1)
    return torch.clamp(2 / largest.clamp(min=SMALLEST_RATIO), max=1)


POWER_ITERATIONS = 5
"""A collective mode stands out of the spectrum: a few iterations find it."""


def mean_strength(graph: Graph, coupling: Tensor) -> Tensor:
    r"""Mean over the coupled variables of ``\sum_j |w_ij|``, ``(*problems,)``; 1 where nothing is coupled."""
    size = coupling.abs()
    per_variable = graph.scatter(size, size)
    mean = per_variable.sum(-1) / (per_variable > 0).sum(-1).clamp(min=1)
    return torch.where(mean > SMALLEST_RATIO, mean, torch.ones_like(mean))


def decisive(graph: Graph, coupling: Tensor, linear: Tensor) -> Tensor:
    r"""Limit \|linear_i\| to what surely decides variable i: twice ``\sum_j |w_ij|``, at least 1.

    Without the limit one huge field would set the step size of the whole machine.
    """
    size = coupling.abs()
    limit = (2 * graph.scatter(size, size)).clamp(min=1)
    return torch.minimum(torch.maximum(linear, -limit), limit)


def expand(x: Tensor, n_axes: int) -> Tensor:
    """Append axes of size 1."""
    return x.reshape(*x.shape, *(1,) * n_axes)


def amax(x: Tensor, n_axes: int) -> Tensor:
    """Maximum over the last axes, 0 where they are empty."""
    axes = tuple(range(-n_axes, 0))
    return x.amax(axes) if math.prod(x.shape[axes[0] :]) else x.sum(axes)
