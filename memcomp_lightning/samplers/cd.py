"""Contrastive divergence."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Generator

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_choice, require_count
from memcomp_lightning.samplers.gibbs import TwoLayerModel, chains_of, has_classes
from memcomp_lightning.types import Configurations, NegativePhase, NoState

Readout = Literal["mean", "sample"]


@dataclass(frozen=True, kw_only=True, slots=True)
class CD:
    """CD-k: k Gibbs sweeps that start at the data (Hinton 2002).

    The hidden units of the last half sweep are kept as conditional means, which has the same expectation
    and less variance than samples (Hinton 2010, section 3). In a model of any connectivity a sweep draws class
    by class, and the last class is kept as means.

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
        """Nothing to remember: every call starts at the data.

        Raises:
            SettingError: Other readouts than the default ones for a model that is not drawn layer by layer.
        """
        for name, default in (("visible", "sample"), ("hidden", "mean")):
            readout, allowed = getattr(self, name), f"{default!r} for a model other than an RBM"
            require(readout == default or not has_classes(model), name, readout, allowed)
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: TwoLayerModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return one configuration an image, k sweeps away from it, with the image's weight."""
        if has_classes(model):
            chains = chains_of(model)
            x = torch.cat((positive.v, rng.bernoulli(positive.h, generator=generator)), dim=-1)
            for _ in range(self.k):
                x = chains.sweep(x, generator=generator)
            return NegativePhase(chains.read(x)._replace(weight=positive.weight), state, {})
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
        return NegativePhase(Configurations(v, h, positive.weight), state, {})
