"""Effective couplings of spins as series in the weights, where summing over all pairs would take minutes."""

import math

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.models.units import Units

DEGREES = (16, 32, 64)
"""Terms of the series for each of two sites, tried one after the other."""

TOLERANCE = 1e-11
"""Of the last terms, relative to the largest one."""

N_NODES = 8
"""Nodes of the Gauss-Hermite rule for the fields of the other sites."""

_NUMBERS = 2**22


def couplings_by_series(
    hidden: Units, weight: Float[Tensor, "n_hidden n"], c: Float[Tensor, " n_hidden"]
) -> tuple[Float[Tensor, "n n"], Tensor]:
    r"""Sum what hidden units contribute to the couplings of spins, and say for which of them it is not known.

    The contribution of one hidden unit to J of two spins is one function of their two weights,

    .. math:: g(x, y) = \frac{1}{4} \sum_{a, b = \pm 1} a b \langle A(c + a x + b y + z) \rangle_z,
        \qquad \mathrm{var}(z) = \sum_k w_k^2 - x^2 - y^2

    with the cumulant A. It is smooth, so a Chebyshev series in either weight gives it for all pairs by one product
    of matrices: 784 spins and 500 hidden units take a second.

    Args:
        hidden: The hidden units.
        weight: Their couplings to the spins, in float64.
        c: Their biases.

    Returns:
        The sum over the hidden units whose series has converged, zero on the diagonal, and the numbers of the
        others: those with a few weights that are far larger than all else.
    """
    n = weight.shape[-1]
    total, left = weight.new_zeros(n, n), torch.arange(len(weight), device=weight.device)
    for degree in DEGREES:
        rows = max(1, _NUMBERS // (degree * max(n, 4 * degree)))
        remaining = []
        for some in left.split(rows):
            terms, converged = _terms(hidden.select(some), weight[some], c[some], degree)
            at = some[converged]
            basis = _basis(weight[at], degree)
            total += (basis @ terms[converged]).movedim(0, 1).flatten(1) @ basis.movedim(0, 1).flatten(1).mT
            remaining.append(some[~converged])
        left = torch.cat(remaining) if remaining else left
        if not len(left):
            break
    return total.fill_diagonal_(0.0), left


def _terms(hidden: Units, weight: Tensor, c: Tensor, degree: int) -> tuple[Tensor, Tensor]:
    """Coefficients of the series, ``(n_hidden, degree, degree)``, and which of them have converged."""
    k = torch.arange(degree, dtype=weight.dtype, device=weight.device)
    angles = math.pi * (2 * k + 1) / (2 * degree)
    at = _largest(weight) * angles.cos()
    x, y = at.unsqueeze(-1), at.unsqueeze(-2)
    rest = weight.square().sum(-1)[:, None, None] - x.square() - y.square()
    deviation, bias = rest.clamp_min(0.0).sqrt(), c[:, None, None]
    nodes, rule = np.polynomial.hermite_e.hermegauss(N_NODES)
    values = torch.zeros_like(rest)
    for node, share in zip(nodes.tolist(), (rule / math.sqrt(2 * math.pi)).tolist(), strict=True):
        for sign, field in ((1.0, x + y), (1.0, -x - y), (-1.0, x - y), (-1.0, y - x)):
            moved = (bias + field + node * deviation).flatten(1).mT
            values += 0.25 * sign * share * hidden.cumulant(moved).mT.unflatten(1, (degree, degree))
    cosines = (k.unsqueeze(-1) * angles).cos() * 2 / degree
    cosines[0] /= 2
    terms = cosines @ values @ cosines.mT
    size = terms.abs()
    last = torch.maximum(size[:, -2:].amax((1, 2)), size[:, :, -2:].amax((1, 2)))
    return terms, last <= TOLERANCE * size.amax((1, 2))


def _basis(weight: Tensor, degree: int) -> Tensor:
    """Chebyshev polynomials of the weights, ``(n_hidden, n, degree)``."""
    angle = (weight / _largest(weight)).clamp(-1.0, 1.0).arccos().unsqueeze(-1)
    return (angle * torch.arange(degree, dtype=weight.dtype, device=weight.device)).cos()


def _largest(weight: Tensor) -> Tensor:
    return weight.abs().amax(-1, keepdim=True).clamp_min(torch.finfo(weight.dtype).tiny)
