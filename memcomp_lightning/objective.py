"""The one loss for every sampler of the negative phase."""

from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.types import Configurations


class HasTotalEnergy(Protocol):
    """An energy model, as far as the objective needs it."""

    def total_energy(self, v: Tensor, h: Tensor, weight: Tensor) -> Tensor:
        """Sum of ``weight * E(v, h)`` over configurations, ``(*replicas,)``; weights of any sign."""
        ...


def contrast(
    model: HasTotalEnergy, positive: Configurations, negative: Configurations
) -> Float[Tensor, "*replicas"]:
    """Return ``mean E(positive) - mean E(negative)`` for each replica, means by the weights.

    With the hidden means given the data as the positive phase and the exact expectation as the negative
    one, its gradient is the gradient of the mean negative log-likelihood (eqs. 4 to 6 of Manukian et al.
    2019, with the sign of a loss). Both phases are constants to autograd. Sum it over the replicas before
    the backward pass: they stay independent.

    Args:
        model: The energy model.
        positive: Configurations with the data clamped.
        negative: Configurations that stand for the model's own distribution.
    """
    weight = torch.cat((shares(positive), -shares(negative)), dim=-1)
    v = torch.cat((positive.v, negative.v), dim=-2)
    h = torch.cat((positive.h, negative.h), dim=-2)
    return model.total_energy(v, h, weight)


def shares(configurations: Configurations) -> Tensor:
    """Weights that add up to one, ``(*replicas, n)``."""
    v, _, weight = configurations
    if weight is None:
        return torch.full(v.shape[:-1], 1.0 / v.shape[-2], dtype=v.dtype, device=v.device)
    return weight / weight.sum(-1, keepdim=True)
