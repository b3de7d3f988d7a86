"""Hidden units, and what is missing of the data, by Gibbs chains."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.mean_field import hidden_blocks
from memcomp_lightning.samplers.positive.base import PositivePhase
from memcomp_lightning.types import Configurations


@dataclass(frozen=True, kw_only=True, slots=True)
class ClampedGibbs:
    """Gibbs chains of the hidden units with the observed ones clamped; the class drawn last is kept as means.

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
    def sample(
        self, model: EnergyModel, v: Tensor, *, observed: Tensor | None = None, generator: Generator
    ) -> PositivePhase:
        """Return ``n_chains`` configurations an image; missing values begin as units without couplings."""
        v = v.repeat_interleave(self.n_chains, dim=-2)
        n = model.n_visible
        free = v.new_zeros(*v.shape[:-1], model.n_hidden)
        h = model.hidden.sample(free, generator=generator)
        moving, fixed = hidden_blocks(model), None
        if observed is not None:
            observed = observed.repeat_interleave(self.n_chains, dim=-2)
            alone = model.visible.sample(model.b.unsqueeze(-2).expand(v.shape), generator=generator)
            v = torch.where(observed, v, alone)
            fixed = torch.cat((observed, torch.zeros_like(free, dtype=torch.bool)), dim=-1)
            # The hidden units follow the start of the visible ones, not the other way round.
            moving = sorted(model.blocks(), key=lambda block: bool((block.units < n).any()))
        x = torch.cat((v, h), dim=-1)
        for _ in range(self.k):
            for block in moving:
                drawn = block.kind.sample(block.field(x), generator=generator)
                at = block.units
                x[..., at] = drawn if fixed is None else torch.where(fixed[..., at], x[..., at], drawn)
        last = hidden_blocks(model)
        if observed is not None:
            for block in last[:-1]:
                x[..., block.units] = block.kind.sample(block.field(x), generator=generator)
        for block in last[-1:]:  # none in a machine without hidden units
            x[..., block.units] = block.kind.mean(block.field(x))
        return PositivePhase(Configurations(x[..., :n], x[..., n:]), {})
