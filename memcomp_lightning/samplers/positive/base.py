"""What a sampler of the positive phase must offer; models need one if their hidden units are coupled."""

from typing import NamedTuple, Protocol

from torch import Generator, Tensor

from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.types import Configurations


class PositivePhase(NamedTuple):
    """What a sampler of the positive phase returns.

    Attributes:
        configurations: Data with hidden units that stand for p(h | v).
        info: Diagnostics, ``(*replicas,)`` each.
    """

    configurations: Configurations
    info: dict[str, Tensor]


class PositivePhaseSampler(Protocol):
    """Supplies the expectation over hidden units with the data clamped."""

    def sample(self, model: EnergyModel, v: Tensor, *, generator: Generator) -> PositivePhase:
        """Return configurations for data ``(*replicas, n, n_visible)`` in [0, 1]."""
