"""Persistent contrastive divergence."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning.defaults import N_CHAINS
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.types import Configurations, NegativePhase


class ChainStates(NamedTuple):
    """States of the persistent chains, ``(*replicas, n_chains, n_units)``: see ``models.base.Chains``."""

    x: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class PCD:
    """PCD-k: k Gibbs sweeps that start where the last update left the chains (Tieleman 2008).

    Attributes:
        k: Sweeps an update, >= 1.
        n_chains: Chains a replica, >= 1; None takes ``chains_per_datum`` for each image in the batch
            (the chunk, of this process) at hand.
        chains_per_datum: >= 1, used where ``n_chains`` is None.
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = False

    k: int = 1
    n_chains: int | None = N_CHAINS
    chains_per_datum: int = 1

    def __post_init__(self) -> None:
        require_count("k", self.k)
        require_count("chains_per_datum", self.chains_per_datum)
        alone = self.chains_per_datum == 1 or self.n_chains is None
        remedy = "Use n_chains=None, on the command line null."
        require(alone, "chains_per_datum", self.chains_per_datum, "1 where n_chains is given", remedy)
        if self.n_chains is not None:
            require_count("n_chains", self.n_chains)

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> ChainStates:
        """Start the chains at random states."""
        n = self.n_chains or n_chains * self.chains_per_datum
        return ChainStates(model.chains().random(n, generator=generator))

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: ChainStates, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[ChainStates]:
        """Return one configuration a chain."""
        chains, x = model.chains(), state.x
        for _ in range(self.k):
            x = chains.sweep(x, generator=generator)
        return NegativePhase(chains.read(x), ChainStates(x.clone()), {})
