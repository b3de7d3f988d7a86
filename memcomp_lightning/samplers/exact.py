"""The exact expectation under the model, by enumeration."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.machine import require_few_bits
from memcomp_lightning.types import Configurations, NegativePhase, NoState


@dataclass(frozen=True, kw_only=True, slots=True)
class Exact:
    """The exact negative phase, for models that are small enough to be enumerated.

    It takes every state of the smaller layer with its probability, and the conditional means of the other layer.
    Their mean energy is the exact expectation, because E is linear in each layer; of real units there are two
    points with the right means and variances. In a model of any connectivity the class with most units takes its
    means; the states of all others are enumerated.

    Attributes:
        max_units: Units in {0, 1} that are enumerated at most, 1 to 20; 2^max_units configurations are held at
            once. A site of q states counts as log2 q of them.
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = True

    max_units: int = 16

    def __post_init__(self) -> None:
        require_count("max_units", self.max_units)
        require(self.max_units <= 20, "max_units", self.max_units, "an integer from 1 to 20")

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> NoState:
        """Check the model's size.

        Raises:
            SettingError: More than ``max_units`` units would be enumerated.
        """
        n, allowed = model.n_enumerated, f"at most max_units = {self.max_units} for the exact sampler"
        remedy = (
            "Use a smaller layer or another sampler (pcd, cd), or raise max_units (at most 20): each unit "
            "doubles time and memory."
        )
        require_few_bits("units to enumerate", n, self.max_units, allowed, remedy)
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return all configurations with their probabilities as weights."""
        return NegativePhase(model.all_configurations(), state, {})
