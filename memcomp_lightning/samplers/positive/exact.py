"""Hidden units given the data, all their states."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.samplers.positive.base import PositivePhase
from memcomp_lightning.types import Configurations


@dataclass(frozen=True, kw_only=True, slots=True)
class ExactPosterior:
    """Every state of the hidden units with its probability given the data.

    Attributes:
        max_units: Hidden units at most, 1 to 16: 2^max_units configurations an image.
    """

    max_units: int = 16

    def __post_init__(self) -> None:
        require_count("max_units", self.max_units)
        require(self.max_units <= 16, "max_units", self.max_units, "an integer from 1 to 16")

    @torch.no_grad()
    def sample(self, model: EnergyModel, v: Tensor, *, generator: Generator) -> PositivePhase:
        """Return all configurations, those of an image with weights that add up to one.

        Raises:
            SettingError: The model has more hidden units.
        """
        n = model.n_hidden
        require(n <= self.max_units, "number of hidden units", n, f"at most max_units = {self.max_units}")
        h = binary_states(n, like=v)
        n_images, n_states = v.shape[-2], len(h)
        v = v.repeat_interleave(n_states, dim=-2)
        h = h.repeat(n_images, 1).expand(*v.shape[:-1], n)
        log_weight = -model.energy(v, h).double().unflatten(-1, (n_images, n_states))
        weight = torch.softmax(log_weight, dim=-1).flatten(-2).to(v.dtype)
        return PositivePhase(Configurations(v, h, weight), {})
