"""The exact expectation under the model, by enumeration."""

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import torch
from torch import Generator, Tensor
from torch.nn.functional import softplus

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.enumeration import binary_states, n_enumerated
from memcomp_lightning.samplers.gibbs import TwoLayerModel, has_classes
from memcomp_lightning.types import Configurations, NegativePhase, NoState


class EnumerableModel(TwoLayerModel, Protocol):
    """A two-layer model with the free energies of both layers."""

    @property
    def n_hidden(self) -> int:
        """Number of hidden units."""
        ...

    def free_energy(self, v: Tensor) -> Tensor:
        """F(v)."""
        ...

    def hidden_free_energy(self, h: Tensor) -> Tensor:
        """F(h)."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Exact:
    """Every state of the smaller layer with its probability, and the conditional means of the other layer.

    The mean energy over these configurations is the exact expectation, because E is linear in each layer. In a
    model of any connectivity the class with most units takes its means; the states of all others are enumerated.

    Attributes:
        max_units: Units that are enumerated at most, 1 to 20; 2^max_units configurations are held at once.
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = True

    max_units: int = 16

    def __post_init__(self) -> None:
        require_count("max_units", self.max_units)
        require(self.max_units <= 20, "max_units", self.max_units, "an integer from 1 to 20")

    def init(self, model: EnumerableModel, n_chains: int, *, generator: Generator) -> NoState:
        """Check the model's size.

        Raises:
            SettingError: The smaller layer has more than ``max_units`` units.
        """
        n_units = n_enumerated(model)
        require(
            n_units <= self.max_units,
            "units outside the largest class" if has_classes(model) else "size of the smaller layer",
            n_units,
            f"at most max_units = {self.max_units} for the exact sampler",
            "Use a smaller layer or another sampler (pcd, cd), or raise max_units (at most 20): each unit "
            "doubles time and memory.",
        )
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: EnumerableModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return all configurations with their probabilities as weights."""
        if has_classes(model):
            return NegativePhase(_all_of_classes(model), state, {})
        hidden_first = model.n_hidden < model.n_visible
        states = binary_states(min(model.n_visible, model.n_hidden), like=model.b)
        states = states.expand(*model.replicas, *states.shape)
        free_energy = model.hidden_free_energy(states) if hidden_first else model.free_energy(states)
        weight = torch.softmax(-free_energy.double(), dim=-1).to(states.dtype)
        if hidden_first:
            configurations = Configurations(model.visible_mean(states), states, weight)
        else:
            configurations = Configurations(states, model.hidden_mean(states), weight)
        return NegativePhase(configurations, state, {})


def _all_of_classes(model: Any) -> Configurations:
    """States of all units but the largest class, that one by its means, with their probabilities."""
    largest = max(model.blocks(), key=lambda block: len(block.units))
    n_visible, n_units = model.n_visible, model.n_visible + model.n_hidden
    others = torch.ones(n_units, dtype=torch.bool, device=model.b.device)
    others[largest.units] = False
    states = binary_states(n_units - len(largest.units), like=model.b)
    x = states.new_zeros(*model.replicas, len(states), n_units)
    x[..., others] = states
    # Summed over the largest class: exp(-E) with that class off, times 1 + exp(field) for each of its units.
    field = largest.field(x)
    log_weight = softplus(field.double()).sum(-1) - model.energy(x[..., :n_visible], x[..., n_visible:]).double()
    x[..., largest.units] = torch.sigmoid(field)
    weight = torch.softmax(log_weight, dim=-1).to(x.dtype)
    return Configurations(x[..., :n_visible], x[..., n_visible:], weight)
