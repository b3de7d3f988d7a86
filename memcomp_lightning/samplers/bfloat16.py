"""Products of matrices in bfloat16 while a chain is swept."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Generator

from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel
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
        with _rounded_products():
            return self.sampler.sample(model, state, positive, generator=generator)


@cache
def multiplies_in_bfloat16() -> bool:
    """Whether torch does so on this processor, found by a product: instructions for it may lie unused."""
    if not torch.backends.mkldnn.is_available():
        return False
    finer_than_bfloat16 = torch.full((_TRIED, _TRIED), 1 + 2.0**-12, dtype=torch.float32, device="cpu")
    one = torch.eye(_TRIED, dtype=torch.float32, device="cpu")
    with _rounded_products():
        return not (finer_than_bfloat16 @ one).equal(finer_than_bfloat16)


_TRIED = 256
"""Rows and columns; torch may leave small products as they are."""


@contextmanager
def _rounded_products() -> Iterator[None]:
    """Let torch multiply float32 matrices in bfloat16."""
    matmul = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    before = matmul.fp32_precision
    matmul.fp32_precision = "bf16"
    try:
        yield
    finally:
        matmul.fp32_precision = before
