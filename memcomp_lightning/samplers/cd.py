"""Contrastive divergence."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator

from memcomp_lightning import rng
from memcomp_lightning.errors import require_count
from memcomp_lightning.samplers.gibbs import TwoLayerModel, sweep
from memcomp_lightning.types import Configurations, NegativePhase, NoState


@dataclass(frozen=True, kw_only=True, slots=True)
class CD:
    """CD-k: k Gibbs sweeps that start at the data (Hinton 2002).

    The hidden units of the last half sweep are kept as conditional means, which has the same expectation
    and less variance than samples (Hinton 2010, section 3).

    Attributes:
        k: Sweeps an update, >= 1.
    """

    uses_data: ClassVar[bool] = True
    shared: ClassVar[bool] = False

    k: int = 1

    def __post_init__(self) -> None:
        require_count("k", self.k)

    def init(self, model: TwoLayerModel, n_chains: int, *, generator: Generator) -> NoState:
        """Nothing to remember: every call starts at the data."""
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: TwoLayerModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return one configuration an image, k sweeps away from it."""
        # The first half sweep takes the hidden means that the positive phase has computed already.
        h = rng.bernoulli(positive.h, generator=generator)
        v = rng.bernoulli(model.visible_mean(h), generator=generator)
        for _ in range(self.k - 1):
            v = sweep(model, v, generator=generator)
        return NegativePhase(Configurations(v, model.hidden_mean(v)), state, {})
