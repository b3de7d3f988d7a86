"""Hidden units given the data, in the mean field."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.mean_field import MeanFieldSolution, mean_field
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

    def sample(
        self, model: EnergyModel, v: Tensor, *, observed: Tensor | None = None, generator: Generator
    ) -> PositivePhase:
        """Return the means; draws nothing. Missing values have their means as well, real units two points."""
        settings: dict[str, Any] = {"max_iterations": self.max_iterations, "tolerance": self.tolerance}
        found = mean_field(model, v, observed=observed, **settings)
        iterations = torch.full_like(found.change, float(found.n_iterations))
        info = {"converged": found.converged.to(v.dtype), "change": found.change, "iterations": iterations}
        configurations = Configurations(v, found.h) if observed is None else _completed(model, v, observed, found)
        return PositivePhase(configurations, {f"mean_field_{name}": value for name, value in info.items()})


@torch.no_grad()
def _completed(model: EnergyModel, v: Tensor, observed: Tensor, found: MeanFieldSolution) -> Configurations:
    """Data with the means in place of what is missing; the points of one row side by side."""
    if model.visible.linear:
        return Configurations(found.v, found.h)
    x, field = torch.cat((found.v, found.h), dim=-1), torch.empty_like(found.v)
    for block in model.blocks():
        seen = block.units < model.n_visible
        field[..., block.units[seen]] = block.field(x)[..., seen]
    filled = [torch.where(observed, v, values) for values in model.visible.points(field)]
    together = torch.stack(filled, dim=-2).flatten(-3, -2)
    return Configurations(together, found.h.repeat_interleave(len(filled), dim=-2))
