"""Hidden units given the data, in the mean field."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.mean_field import mean_field
from memcomp_lightning.samplers.positive.base import PositivePhase
from memcomp_lightning.types import Configurations


@dataclass(frozen=True, kw_only=True, slots=True)
class MeanField:
    """Factorised p(h | v), by :func:`memcomp_lightning.models.mean_field`.

    Training then follows a lower bound of the likelihood. ``info`` says for each replica whether it converged
    ("mean_field_converged"), the last change of a mean and the iterations.

    Attributes:
        max_iterations: >= 1; without convergence by then, the last means are used.
        tolerance: Largest change of a mean that counts as converged, > 0.
    """

    max_iterations: int = 30
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        require(self.tolerance > 0, "tolerance", self.tolerance, "a number > 0")

    def sample(self, model: EnergyModel, v: Tensor, *, generator: Generator) -> PositivePhase:
        """Return the means; draws nothing."""
        found = mean_field(model, v, max_iterations=self.max_iterations, tolerance=self.tolerance)
        iterations = torch.full_like(found.change, float(found.n_iterations))
        info = {"converged": found.converged.to(v.dtype), "change": found.change, "iterations": iterations}
        return PositivePhase(
            Configurations(v, found.h), {f"mean_field_{name}": value for name, value in info.items()}
        )
