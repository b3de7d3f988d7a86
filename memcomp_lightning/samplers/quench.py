"""A random start, one hot sweep, one sweep at the target temperature."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.types import Configurations, NegativePhase, NoState


@dataclass(frozen=True, kw_only=True, slots=True)
class Quench:
    """Two sweeps from random states, which matched a quantum annealer (Job & Adachi, arXiv 2009.00134).

    Attributes:
        beta_hot: Inverse temperature of the first sweep, in [0, 1].
        n_chains: Starts a replica, >= 1; None takes as many as there are images in the batch
            (the chunk, of this process) at hand.
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = False

    beta_hot: float = 0.1
    n_chains: int | None = 100

    def __post_init__(self) -> None:
        require(0 <= self.beta_hot <= 1, "beta_hot", self.beta_hot, "a number in [0, 1]")
        if self.n_chains is not None:
            require_count("n_chains", self.n_chains)

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> NoState:
        """Nothing to remember: every call starts at random states."""
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return one configuration a start."""
        chains = model.chains()
        x = chains.random(self.n_chains or positive.v.shape[-2], generator=generator)
        x = chains.sweep(x, beta=self.beta_hot, generator=generator)
        x = chains.sweep(x, generator=generator)
        return NegativePhase(chains.read(x), state, {})
