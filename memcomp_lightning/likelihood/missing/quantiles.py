"""Quantiles of mixtures of normal distributions."""

import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.likelihood.layers import NUMBERS

_STEPS = 26
"""Halvings of the interval between the quantiles of the lowest and the highest component."""


def mixture_quantile(
    weight: Float[Tensor, "#n k"], mean: Float[Tensor, "#n k"], deviation: float, share: float
) -> Float[Tensor, " n"]:
    r"""The x with :math:`\sum_k w_k \Phi((x - \mu_k) / \sigma)` equal to a share, by bisection.

    Args:
        weight: Of the components; they add up to one.
        mean: Of the components.
        deviation: Of every component.
        share: In (0, 1).
    """
    n = max(len(weight), len(mean))
    rows = max(1, NUMBERS // weight.shape[-1])
    weight, mean = (x.expand(n, -1) for x in (weight, mean))
    return torch.cat(
        [_bisected(*some, deviation, share) for some in zip(weight.split(rows), mean.split(rows), strict=True)]
    )


def _bisected(weight: Tensor, mean: Tensor, deviation: float, share: float) -> Tensor:
    # No component has more than its share below the quantile of the highest one, nor less below the lowest one's.
    normal = deviation * torch.special.ndtri(torch.tensor(share, dtype=mean.dtype, device=mean.device))
    low, high = mean.amin(-1) + normal, mean.amax(-1) + normal
    for _ in range(_STEPS):
        middle: Tensor = (low + high) / 2
        below = (weight * torch.special.ndtr((middle.unsqueeze(-1) - mean) / deviation)).sum(-1)
        low, high = torch.where(below < share, middle, low), torch.where(below < share, high, middle)
    return middle
