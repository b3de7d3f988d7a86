"""What RBMs and Boltzmann machines share: numbers of units, and sums of the energy over configurations."""

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import cast

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.linalg import vecdot

from memcomp_lightning.ambient import in_own_dtypes, with_gradient
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel, Hidden, PerReplica, PerState, Visible
from memcomp_lightning.models.bit_form import BitForm, bit_form
from memcomp_lightning.models.units import Bernoulli, Mixed, Units
from memcomp_lightning.objective import shares
from memcomp_lightning.types import Configurations, Weighted


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
        parts = [Weighted(v, h, weight)]
        with torch.no_grad():
            moments = self._moments(parts)
        return self._energy_of(moments) + self._of_measures(parts)

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
        parts, offsets = [Weighted(v, h, weight)], (visible_offset, hidden_offset)
        with torch.no_grad():
            centred = _centred(parts, *offsets)
            moments = self._own_moments(self._moments(centred), *offsets)
            plain = self._plain_moments(moments, *offsets)
            value = self._energy_of(plain) + self._of_measures(parts)
        surrogate = self._energy_of(moments) + self._of_centred_measures(centred, visible_offset)
        return value + (surrogate - surrogate.detach())

    @with_gradient()
    def add_gradient(
        self, parts: Sequence[Weighted], offsets: tuple[Tensor, Tensor] | None = None, *, valued: bool = True
    ) -> PerReplica | None:
        """Add to the parameters' gradients those of :meth:`total_energy` over all parts together.

        Couplings and biases need no graph: their gradients are the moments. What the units have of their own goes
        through autograd.

        Args:
            parts: Configurations and their weights.
            offsets: Of visible and hidden units, for :meth:`centred_total_energy`; None is the plain energy.
            valued: Whether to return the sum, which a loop that nothing looks at does without.
        """
        if self.b.dtype.itemsize < 4:  # of few digits: a sum over one part must not be rounded before the next
            v, h, weight = zip(*parts, strict=True)
            parts = [Weighted(torch.cat(v, dim=-2), torch.cat(h, dim=-2), torch.cat(weight, dim=-1))]
        with torch.no_grad():
            falling = [part._replace(weight=-part.weight) for part in parts]
            moments = self._moments(falling if offsets is None else _centred(falling, *offsets))
            if offsets is not None:
                moments = self._own_moments(moments, *offsets)
            value: Tensor | float = 0.0
            if valued:  # now, as gradients may take the moments' place
                value = -self._energy_of(moments if offsets is None else self._plain_moments(moments, *offsets))
            for parameter, moment in self._by_parameter(moments):
                if parameter.requires_grad:
                    parameter.grad = moment if parameter.grad is None else parameter.grad.add_(moment)
        measures = own = self._of_measures(parts) if valued or offsets is None else 0.0
        if offsets is not None:
            own = self._of_centred_measures(_centred(parts, *offsets), offsets[0])
        if isinstance(own, Tensor) and own.requires_grad:
            own.sum().backward()
        return torch.as_tensor(value + measures).detach() if valued else None

    def _of_measures(self, parts: Sequence[Weighted]) -> Tensor | float:
        """Weighted sum of ``-log mu`` over configurations."""
        total: Tensor | float = 0.0
        for v, h, weight in parts:
            for units, x in ((self.visible, v), (self.hidden, h)):
                if not units.linear:
                    total = total + units.total_energy(x, weight)
        return total

    def _of_centred_measures(self, centred: Sequence[Weighted], visible_offset: Tensor) -> Tensor | float:
        """What learned precisions add to the surrogate whose gradient is that of centred units."""
        curvature = self.visible.curvature
        if curvature is None or not curvature.requires_grad:
            return 0.0
        with torch.no_grad():
            squares = 0.5 * sum((weight.unsqueeze(-2) @ v.square()).squeeze(-2) for v, _, weight in centred)
            along = _learned(self.visible, visible_offset.device) * visible_offset * squares
        total: Tensor = vecdot(curvature, squares) + vecdot(self.b, along)
        return total

    @abstractmethod
    def _moments(self, parts: Sequence[Weighted]) -> Sequence[Tensor]:
        """Weighted sums over configurations of what the parameters are multiplied with."""

    @abstractmethod
    def _own_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> Sequence[Tensor]:
        """Moments of centred units as steps of the model's own parameters."""

    @abstractmethod
    def _plain_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> Sequence[Tensor]:
        """What :meth:`_moments` gives, from those of weights that add up to 0 after :meth:`_own_moments`."""

    @abstractmethod
    def _by_parameter(self, moments: Sequence[Tensor]) -> list[tuple[nn.Parameter, Tensor]]:
        """Couplings and biases, each with its moment."""

    @abstractmethod
    def _energy_of(self, moments: Sequence[Tensor]) -> Tensor:
        """Minus the sum over the parameters of each one times its moment, ``(*replicas,)``."""


def _centred(parts: Sequence[Weighted], visible_offset: Tensor, hidden_offset: Tensor) -> list[Weighted]:
    mu, lam = visible_offset.unsqueeze(-2), hidden_offset.unsqueeze(-2)
    return [Weighted(v - mu, h - lam, weight) for v, h, weight in parts]


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
