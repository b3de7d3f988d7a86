"""Contrastive divergence."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Generator

from memcomp_lightning import rng
from memcomp_lightning.errors import require_choice, require_count
from memcomp_lightning.samplers.gibbs import TwoLayerModel
from memcomp_lightning.types import Configurations, NegativePhase, NoState

Readout = Literal["mean", "sample"]


@dataclass(frozen=True, kw_only=True, slots=True)
class CD:
    """CD-k: k Gibbs sweeps that start at the data (Hinton 2002).

    The hidden units of the last half sweep are kept as conditional means, which has the same expectation
    and less variance than samples (Hinton 2010, section 3).

    Attributes:
        k: Sweeps an update, >= 1.
        visible: The last visible units: "sample", or "mean", which is biased towards smooth reconstructions.
        hidden: The last hidden units: "mean" or "sample".
    """

    uses_data: ClassVar[bool] = True
    shared: ClassVar[bool] = False

    k: int = 1
    visible: Readout = "sample"
    hidden: Readout = "mean"

    def __post_init__(self) -> None:
        require_count("k", self.k)
        require_choice("visible", self.visible, ("sample", "mean"))
        require_choice("hidden", self.hidden, ("mean", "sample"))

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
        for _ in range(self.k - 1):
            v = rng.bernoulli(model.visible_mean(h), generator=generator)
            h = rng.bernoulli(model.hidden_mean(v), generator=generator)
        v = model.visible_mean(h)
        if self.visible == "sample":
            v = rng.bernoulli(v, generator=generator)
        h = model.hidden_mean(v)
        if self.hidden == "sample":
            h = rng.bernoulli(h, generator=generator)
        return NegativePhase(Configurations(v, h), state, {})
