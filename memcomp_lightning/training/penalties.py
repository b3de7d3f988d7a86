"""Penalties on the couplings of an energy model, which updates add to the contrast; biases are free."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.arrays import moved
from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.units import Units


class Penalty(Protocol):
    """What the couplings of a model cost, beside the contrast."""

    def __call__(self, model: EnergyModel) -> Float[Tensor, "*replicas"]:
        """The loss of each replica, differentiable in the couplings."""


@dataclass(frozen=True, slots=True)
class L1:
    r"""Pulls each coupling to zero by the same amount, which leaves few that count: :math:`\lambda \sum |w|`.

    Its part of an update with the rate :math:`\eta` is :math:`\eta \lambda`: couplings that it keeps at zero are
    within about that, not zero to the last digit. Of categorical units it depends on the gauge.

    Attributes:
        strength: :math:`\lambda`, >= 0 and finite.
    """

    strength: float

    def __post_init__(self) -> None:
        _require_strength(self)

    def __call__(self, model: EnergyModel) -> Float[Tensor, "*replicas"]:
        """The sum of absolute values, times the strength."""
        return self.strength * _couplings(model).abs().sum(-1)


@dataclass(frozen=True, slots=True)
class L2:
    r"""Pulls couplings to zero by their size, which keeps them small: :math:`\frac{\lambda}{2} \sum w^2`.

    With plain gradient descent it is the ``weight_decay`` of torch's optimisers on the couplings alone. Of
    categorical units it is smallest in the zero-sum gauge.

    Attributes:
        strength: :math:`\lambda`, >= 0 and finite.
    """

    strength: float

    def __post_init__(self) -> None:
        _require_strength(self)

    def __call__(self, model: EnergyModel) -> Float[Tensor, "*replicas"]:
        """Half of the sum of squares, times the strength."""
        return 0.5 * self.strength * _couplings(model).square().sum(-1)


@dataclass(frozen=True, slots=True)
class GroupSparsity:
    r"""Pulls whole pairs of sites to zero: :math:`\lambda \sum_{pairs} \sqrt{\sum w^2}` (Yuan & Lin 2006).

    The inner sum is over the couplings between two sites: q times q for two categorical ones, q for a categorical
    one and a bit, a spin or a real unit, one for two of these, where it is :class:`L1`. All groups cost the same,
    whatever their size. Of categorical units it is smallest in the zero-sum gauge.

    Attributes:
        strength: :math:`\lambda`, >= 0 and finite.
    """

    strength: float

    def __post_init__(self) -> None:
        _require_strength(self)

    def __call__(self, model: EnergyModel) -> Float[Tensor, "*replicas"]:
        """The sum of the norms, times the strength."""
        coupling, (group, n_groups) = _couplings(model), _groups(model)
        if n_groups == 0:
            return coupling.sum(-1)
        squares = coupling.new_zeros(*coupling.shape[:-1], n_groups)
        squares = squares.index_add(-1, group, coupling.square())
        is_zero = squares == 0
        norms = squares.masked_fill(is_zero, 1.0).sqrt().masked_fill(is_zero, 0.0)  # the root has no slope at 0
        return self.strength * norms.sum(-1)


def with_penalties(gap: Tensor, model: EnergyModel, penalties: Sequence[Penalty]) -> Tensor:
    """A contrast ``(*replicas,)`` and what the penalties add to it."""
    for penalty in penalties:
        gap = gap + penalty(model)
    return gap


def _couplings(model: EnergyModel) -> Tensor:
    """All couplings, ``(*replicas, n)``."""
    return model.quadratic_form().coupling.flatten(len(model.replicas))


def _groups(model: EnergyModel) -> tuple[Tensor, int]:
    """For each coupling the number of its pair of sites, ``(n,)``; and how many pairs there are."""
    form, visible = model.quadratic_form(), model.visible
    if form.pairs is None:
        first, second = _site_of(model.hidden, model), _site_of(visible, model)
        return (first.unsqueeze(-1) * visible.n_sites + second).flatten(), model.hidden.n_sites * visible.n_sites
    site_of = torch.cat((_site_of(visible, model), _site_of(model.hidden, model) + visible.n_sites))
    first, second = site_of[form.pairs].unbind(-1)
    n_sites = visible.n_sites + model.hidden.n_sites
    if n_sites == model.n_units:  # an entry a site: each coupling is its own group, and nothing is sorted
        return torch.arange(len(first), device=first.device), len(first)
    pairs, number = (first * n_sites + second).unique(return_inverse=True)
    return number, len(pairs)


def _site_of(units: Units, model: EnergyModel) -> Tensor:
    site_of: Tensor = moved(units.site_of(), model.b.device)
    return site_of


def _require_strength(penalty: L1 | L2 | GroupSparsity) -> None:
    name, strength = f"{type(penalty).__name__} strength", penalty.strength
    require(0 <= strength < float("inf"), name, strength, "a finite number >= 0")
