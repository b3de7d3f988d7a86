"""Contrastive divergence."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator

from memcomp_lightning.errors import require, require_choice, require_count
from memcomp_lightning.models.base import EnergyModel, Readout
from memcomp_lightning.types import Configurations, NegativePhase, NoState


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

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> NoState:
        """Nothing to remember: every call starts at the data.

        Raises:
            SettingError: Other readouts than the default ones for a model that is not drawn layer by layer; means
                of visible units whose variance is learned.
        """
        for name, default in (("visible", "sample"), ("hidden", "mean")):
            readout, allowed = getattr(self, name), f"{default!r} for a model other than an RBM"
            require(readout == default or model.chains().free_readout, name, readout, allowed)
        # Squares of means lack the variance: a learned precision would follow a wrong gradient.
        learned = any(parameter.requires_grad for parameter in model.visible.parameters())
        allowed = "'sample' for real units whose precision is learned"
        require(self.visible == "sample" or not learned, "visible", self.visible, allowed)
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return one configuration an image, k sweeps away from it, with the image's weight."""
        readout = {"visible": self.visible, "hidden": self.hidden}
        found = model.chains().from_data(positive, self.k, **readout, generator=generator)
        return NegativePhase(found, state, {})
