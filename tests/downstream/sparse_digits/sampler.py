"""A sampler of the negative phase."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models import RBM
from memcomp_lightning.types import Configurations, NegativePhase


class Chains(NamedTuple):
    """Both layers of each chain, ``(*replicas, n_chains, n_units)``."""

    v: Tensor
    h: Tensor


@dataclass(frozen=True, kw_only=True)
class RandomScan:
    """Persistent Gibbs chains that redraw each unit with probability ``share`` in a half sweep.

    Given which units are drawn, a half sweep is a Gibbs step of theirs: the model's distribution is left as it is.

    Attributes:
        share: In (0, 1].
        n_sweeps: Sweeps an update, >= 1.
        n_chains: Chains a replica, >= 1.
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = False

    share: float = 0.5
    n_sweeps: int = 2
    n_chains: int = 100

    def __post_init__(self) -> None:
        require(0 < self.share <= 1, "share", self.share, "a number in (0, 1]")
        require_count("n_sweeps", self.n_sweeps)
        require_count("n_chains", self.n_chains)

    def init(self, model: RBM, n_chains: int, *, generator: Generator) -> Chains:
        """Start the chains at random states."""
        layers = (model.b.detach(), model.c.detach())
        half = (torch.full_like(bias, 0.5).unsqueeze(-2).repeat_interleave(self.n_chains, -2) for bias in layers)
        return Chains(*(rng.bernoulli(probability, generator=generator) for probability in half))

    @torch.no_grad()
    def sample(
        self, model: RBM, state: Chains, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[Chains]:
        """Return one configuration a chain, its hidden units as means."""
        v, h = state
        for _ in range(self.n_sweeps):
            h = self._redrawn(h, model.hidden_mean(v), generator)
            v = self._redrawn(v, model.visible_mean(h), generator)
        return NegativePhase(Configurations(v, model.hidden_mean(v)), Chains(v.clone(), h), {})

    def _redrawn(self, units: Tensor, mean: Tensor, generator: Generator) -> Tensor:
        drawn = rng.bernoulli(torch.full_like(mean, self.share), generator=generator).bool()
        return torch.where(drawn, rng.bernoulli(mean, generator=generator), units)
