"""Hidden units given the data, all their states."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel, PerState, Visible
from memcomp_lightning.models.machine import log2_states, require_few_bits
from memcomp_lightning.models.observed import log_weight_of_hidden, visible_field
from memcomp_lightning.models.units import all_states
from memcomp_lightning.samplers.positive.base import PositivePhase
from memcomp_lightning.types import Configurations


@dataclass(frozen=True, kw_only=True, slots=True)
class ExactPosterior:
    """Every state of the hidden units with its probability given the data.

    Attributes:
        max_units: Hidden units at most, 1 to 16: 2^max_units configurations an image.
    """

    max_units: int = 16

    def __post_init__(self) -> None:
        require_count("max_units", self.max_units)
        require(self.max_units <= 16, "max_units", self.max_units, "an integer from 1 to 16")

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, v: Tensor, *, observed: Tensor | None = None, generator: Generator
    ) -> PositivePhase:
        """Return all configurations, those of an image with weights that add up to one.

        What is missing is summed: it has its means given each hidden state, real units two points.

        Raises:
            SettingError: The model has more hidden units, or couples visible ones and values are missing.
        """
        n = log2_states(model.hidden)
        require_few_bits("number of hidden units", n, self.max_units, f"at most max_units = {self.max_units}")
        if observed is None:
            return PositivePhase(with_all_hidden(model, v)[0], {})
        states = all_states(model.hidden, v)
        h = states.repeat(v.shape[-2], 1).expand(*v.shape[:-2], -1, -1)
        states = states.expand(*model.replicas, *states.shape)
        log_weight = log_weight_of_hidden(model, v, observed, states).double()
        weight, parts = torch.softmax(log_weight, dim=-1).to(v.dtype), []
        points = model.visible.points(visible_field(model, states))
        for values in points:
            filled = torch.where(observed.unsqueeze(-2), v.unsqueeze(-2), values.unsqueeze(-3))
            parts.append(filled)
        # Points of one image side by side, as those of its states.
        v = torch.stack(parts, dim=-2).flatten(-4, -2)
        h = h.repeat_interleave(len(points), dim=-2)
        weight = (weight / len(points)).flatten(-2).repeat_interleave(len(points), dim=-1)
        return PositivePhase(Configurations(v, h, weight), {})


def with_all_hidden(model: EnergyModel, v: Visible) -> tuple[Configurations, PerState]:
    """Rows with each hidden state, those of a row side by side with weights p(h | v), and log of sum exp(-E)."""
    states = all_states(model.hidden, v)
    wide = v.repeat_interleave(len(states), dim=-2)
    h = states.repeat(v.shape[-2], 1).expand(*wide.shape[:-1], model.n_hidden)
    log_joint = -model.energy(wide, h).double().unflatten(-1, (v.shape[-2], len(states)))
    weight = torch.softmax(log_joint, dim=-1).flatten(-2).to(v.dtype)
    return Configurations(wide, h, weight), log_joint.logsumexp(-1)
