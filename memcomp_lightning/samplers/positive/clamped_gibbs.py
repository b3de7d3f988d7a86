"""Hidden units given the data, by Gibbs chains."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.mean_field import hidden_blocks
from memcomp_lightning.samplers.positive.base import PositivePhase
from memcomp_lightning.types import Configurations


@dataclass(frozen=True, kw_only=True, slots=True)
class ClampedGibbs:
    """Gibbs chains of the hidden units with the visible ones clamped; the class drawn last is kept as means.

    Attributes:
        k: Sweeps from a random start, >= 1.
        n_chains: For each image, >= 1.
    """

    k: int = 10
    n_chains: int = 1

    def __post_init__(self) -> None:
        require_count("k", self.k)
        require_count("n_chains", self.n_chains)

    @torch.no_grad()
    def sample(self, model: EnergyModel, v: Tensor, *, generator: Generator) -> PositivePhase:
        """Return ``n_chains`` configurations an image."""
        v = v.repeat_interleave(self.n_chains, dim=-2)
        half = v.new_full((*v.shape[:-1], model.n_hidden), 0.5)
        x = torch.cat((v, rng.bernoulli(half, generator=generator)), dim=-1)
        blocks = hidden_blocks(model)
        for _ in range(self.k):
            for block in blocks:
                x[..., block.units] = rng.bernoulli(torch.sigmoid(block.field(x)), generator=generator)
        for last in blocks[-1:]:  # none in a machine without hidden units
            x[..., last.units] = torch.sigmoid(last.field(x))
        return PositivePhase(Configurations(v, x[..., model.n_visible :]), {})
