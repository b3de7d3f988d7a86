"""The one loss for every sampler of the negative phase."""

from typing import Protocol

from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.types import Configurations


class HasMeanEnergy(Protocol):
    """An energy model, as far as the objective needs it."""

    def mean_energy(self, configurations: Configurations) -> Tensor:
        """Weighted mean energy of configurations, ``(*replicas,)``."""
        ...


def contrast(
    model: HasMeanEnergy, positive: Configurations, negative: Configurations
) -> Float[Tensor, "*replicas"]:
    """Return ``mean E(positive) - mean E(negative)`` for each replica.

    With the hidden means given the data as the positive phase and the exact expectation as the negative
    one, its gradient is the gradient of the mean negative log-likelihood (eqs. 4 to 6 of Manukian et al.
    2019, with the sign of a loss). Both phases are constants to autograd. Sum it over the replicas before
    the backward pass: they stay independent.

    Args:
        model: The energy model.
        positive: Configurations with the data clamped.
        negative: Configurations that stand for the model's own distribution.
    """
    return model.mean_energy(positive) - model.mean_energy(negative)
