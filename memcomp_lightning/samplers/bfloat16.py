"""Products of matrices in bfloat16 while a chain is swept."""

from dataclasses import dataclass
from typing import Any

from torch import Generator

from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.products import by_onednn, multiplies_in_bfloat16
from memcomp_lightning.samplers.cd import CD
from memcomp_lightning.samplers.pcd import PCD
from memcomp_lightning.types import Configurations, NegativePhase

PRODUCTS = ("float32", "bf16")
"""Number formats in which a sampler may multiply; sums are in float32 in both."""


@dataclass(frozen=True, kw_only=True, slots=True)
class InBfloat16:
    """CD or PCD that multiplies in bfloat16, eight binary digits, where the processor does so by itself.

    Fields of the units are then sums, in float32, of rounded weights: right to some 0.4 %. The positive phase and
    the gradient stay in float32.

    Attributes:
        sampler: CD or PCD. Others compare energies of states, which these digits are too few for.
    """

    sampler: CD | PCD

    def __post_init__(self) -> None:
        kind = type(self.sampler).__name__
        require(isinstance(self.sampler, CD | PCD), "sampler with products in bf16", kind, "CD or PCD")

    @property
    def uses_data(self) -> bool:
        """As the sampler that multiplies."""
        return self.sampler.uses_data

    @property
    def shared(self) -> bool:
        """As the sampler that multiplies."""
        return self.sampler.shared

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> Any:
        """Start the sampler.

        Raises:
            SettingError: The model is on another device, or this processor does not multiply in bfloat16.
        """
        remedy = "Take pretrain.products=float32."
        place = model.b.device.type
        require(place == "cpu", "device of a model with products in bf16", place, "cpu", remedy)
        allowed = "a processor on which torch multiplies float32 in bfloat16, as with AMX"
        require(multiplies_in_bfloat16(), "processor for products in bf16", "this one", allowed, remedy)
        return self.sampler.init(model, n_chains, generator=generator)

    def sample(
        self, model: EnergyModel, state: Any, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[Any]:
        """Return what the sampler returns."""
        with by_onednn():
            return self.sampler.sample(model, state, positive, generator=generator)
