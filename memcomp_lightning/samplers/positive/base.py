"""What a sampler of the positive phase must offer: for coupled hidden units, and for data with missing values."""

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

    def sample(
        self, model: EnergyModel, v: Tensor, *, observed: Tensor | None = None, generator: Generator
    ) -> PositivePhase:
        """Return configurations for data ``(*replicas, n, n_visible)``, those of one row side by side.

        Where ``observed``, a mask of this shape, is False, the value is missing: whatever stands there is not
        read, and the configurations have values of these units that stand for p(missing, h | observed).
        """
