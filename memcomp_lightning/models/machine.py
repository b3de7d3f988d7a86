"""What RBMs and Boltzmann machines share: numbers of units, and sums of the energy over configurations."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.linalg import vecdot

from memcomp_lightning.ambient import in_own_dtypes
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel, Hidden, PerReplica, PerState, Visible
from memcomp_lightning.models.bit_form import BitForm, bit_form
from memcomp_lightning.models.units import Bernoulli, Mixed, Units
from memcomp_lightning.objective import shares
from memcomp_lightning.types import Configurations


class Machine(nn.Module):
    """Units with biases, and couplings between pairs of them.

    The energy is linear in the parameters: a sum over configurations needs only the *moments*, the sums of what
    each parameter is multiplied with, and no product of matrices in its backward pass.

    Args:
        visible: The kind of the visible units, with the model's replica axes.
        hidden: The kind of the hidden units.
    """

    b: nn.Parameter
    c: nn.Parameter

    def __init__(self, visible: Units, hidden: Units) -> None:
        super().__init__()
        self.visible = visible
        self.hidden = hidden

    @property
    def n_visible(self) -> int:
        """Number of visible units."""
        return self.b.shape[-1]

    @property
    def n_hidden(self) -> int:
        """Number of hidden units."""
        return self.c.shape[-1]

    @property
    def n_units(self) -> int:
        """Number of all units."""
        return self.n_visible + self.n_hidden

    @property
    def replicas(self) -> tuple[int, ...]:
        """Leading axes of independent machines."""
        return tuple(self.b.shape[:-1])

    def energy(self, v: Visible, h: Hidden) -> PerState:
        """E(v, h) of each configuration."""
        energy = self.tempered_energy(v, h)
        for units, x in ((self.visible, v), (self.hidden, h)):
            if not units.linear:
                energy = energy + units.energy(x)
        return energy

    @abstractmethod
    def tempered_energy(self, v: Visible, h: Hidden) -> PerState:
        """E(v, h) without the measures of the units: what an inverse temperature multiplies."""

    def project(self) -> None:
        """Bring the units' own parameters back to where they are allowed, after a step of an optimiser."""
        for units in (self.visible, self.hidden):
            units.project()

    def in_bits(self) -> BitForm:
        """The energy in bits, for solvers of QUBOs.

        Raises:
            SettingError: The model has units without a form in bits.
        """
        return bit_form(cast(EnergyModel, self))

    def mean_energy(self, configurations: Configurations) -> PerReplica:
        """Mean of E over configurations, by their weights."""
        return self.total_energy(configurations.v, configurations.h, shares(configurations))

    @in_own_dtypes
    def total_energy(self, v: Visible, h: Hidden, weight: PerState) -> PerReplica:
        """Weighted sum of E over configurations, constants to autograd; the weights may have any sign."""
        with torch.no_grad():
            moments = self._moments(v, h, weight)
        return self._energy_of(moments) + self._of_measures(v, h, weight)

    @in_own_dtypes
    def centred_total_energy(
        self,
        v: Visible,
        h: Hidden,
        weight: PerState,
        visible_offset: Float[Tensor, "*replicas n_visible"],
        hidden_offset: Float[Tensor, "*replicas n_hidden"],
    ) -> PerReplica:
        r"""The value of :meth:`total_energy` for weights that add up to 0, with the gradient of centred units.

        (Montavon & Mueller 2012.) Real units are centred in their squares too: with the energy
        :math:`\gamma (v - \mu)^2 / 2 - b' (v - \mu)` a step of :math:`\gamma` moves
        :math:`b = b' + \gamma \mu` with it.
        """
        with torch.no_grad():
            moments = self._centred_moments(v, h, weight, visible_offset, hidden_offset)
            plain = self._plain_moments(moments, visible_offset, hidden_offset)
            value = self._energy_of(plain) + self._of_measures(v, h, weight)
        surrogate = self._energy_of(moments)
        curvature = self.visible.curvature
        if curvature is not None and curvature.requires_grad:
            with torch.no_grad():
                centred = v - visible_offset.unsqueeze(-2)
                squares = 0.5 * (weight.unsqueeze(-2) @ centred.square()).squeeze(-2)
                along = _learned(self.visible, squares.device) * visible_offset * squares
            surrogate = surrogate + vecdot(curvature, squares) + vecdot(self.b, along)
        return value + (surrogate - surrogate.detach())

    def _of_measures(self, v: Tensor, h: Tensor, weight: Tensor) -> Tensor | float:
        """Weighted sum of ``-log mu`` over configurations."""
        total: Tensor | float = 0.0
        for units, x in ((self.visible, v), (self.hidden, h)):
            if not units.linear:
                total = total + units.total_energy(x, weight)
        return total

    @abstractmethod
    def _moments(self, v: Tensor, h: Tensor, weight: Tensor) -> Sequence[Tensor]:
        """Weighted sums over configurations of what the parameters are multiplied with."""

    @abstractmethod
    def _centred_moments(
        self, v: Tensor, h: Tensor, weight: Tensor, visible_offset: Tensor, hidden_offset: Tensor
    ) -> Sequence[Tensor]:
        """The same sums of the centred parametrisation, turned into those of the model's own parameters."""

    @abstractmethod
    def _plain_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> Sequence[Tensor]:
        """What :meth:`_moments` gives, from the centred ones of weights that add up to 0: no sums over rows."""

    @abstractmethod
    def _energy_of(self, moments: Sequence[Tensor]) -> Tensor:
        """Minus the sum over the parameters of each one times its moment, ``(*replicas,)``."""


def _learned(units: Units, device: torch.device) -> Tensor:
    """Which entries have a precision that training changes, ``(n,)``."""
    if isinstance(units, Mixed):
        return torch.cat([_learned(kind, device) for kind in units.kinds])
    curvature = units.curvature
    is_learned = curvature is not None and curvature.requires_grad
    return torch.full((units.n,), is_learned, dtype=torch.bool, device=device)


def units_of(layer: str, n: int | None, units: Units | None) -> Units:
    """The kind of a layer: the given one, or n units in {0, 1}."""
    if units is None:
        require_count(f"n_{layer}", n)
        assert n is not None
        return Bernoulli(n)
    require(isinstance(units, Units), f"{layer} units", units, "a kind of memcomp_lightning.models.units")
    require(units.n >= 1, f"n_{layer}", units.n, "an integer >= 1")
    require(n in (None, units.n), f"n_{layer}", n, f"{units.n}, as the {layer} units have it, or None")
    return units


def log2_states(units: Units) -> float:
    """The bits that it takes to number the states of a layer; a whole number where they are a power of two."""
    bits = math.log2(units.n_states)
    return int(bits) if bits == int(bits) else bits


def require_few_bits(name: str, n: float, most: int, allowed: str, remedy: str = "") -> None:
    """Raise a SettingError unless at most so many bits number the states that would be enumerated.

    Args:
        name: What is enumerated, as a number of units in {0, 1}.
        n: See :func:`log2_states`.
        most: How many are allowed.
        allowed: The same in words.
        remedy: What to do about it.
    """
    whole = isinstance(n, int)
    require(n <= most, name if whole else f"{name}, in bits", n if whole else round(n, 1), allowed, remedy)


def joined(parts: Sequence[Configurations]) -> Configurations:
    """Configurations one after the other, all with weights."""
    if len(parts) == 1:
        return parts[0]
    v, h, weight = zip(*parts, strict=True)
    return Configurations(torch.cat(v, dim=-2), torch.cat(h, dim=-2), torch.cat(weight, dim=-1))
