"""What a kind of units must offer to be a layer of an energy model."""

import copy
from abc import abstractmethod
from collections.abc import Sequence
from itertools import chain
from typing import ClassVar, NamedTuple, Self

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn

from memcomp_lightning.errors import SettingError, require, require_count

Values = Float[Tensor, "*axes n"]
"""Entries of a layer."""
PerSite = Float[Tensor, "*axes n_sites"]
"""One number for each site of a layer."""


class Bits(NamedTuple):
    """How a layer is written in bits: entry ``at[k]`` is ``low + width * bit k``; the others are integrated out.

    Attributes:
        at: Entries that a bit stands for, ``(n_bits,)`` int64.
        low: Their values where the bit is 0, ``(n_bits,)``.
        width: What they gain where it is 1, ``(n_bits,)``.
        groups: Bits of which exactly one is 1, as numbers from 0 to ``n_bits - 1``.
    """

    at: Tensor
    low: Tensor
    width: Tensor
    groups: Sequence[Sequence[int]] = ()

    def lone(self) -> list[int]:
        """Bits that belong to no group."""
        grouped = set(chain.from_iterable(self.groups))
        return [bit for bit in range(len(self.at)) if bit not in grouped]


class Units(nn.Module):
    r"""A kind of units: how the values x of a layer are distributed, given the fields that act on them.

    .. math:: p(x | f) = \mu(x) \exp(f \cdot x - \sum_{sites} A(f))

    with the *field* f (bias plus couplings), a measure :math:`\mu` that is the kind's own, and the *cumulant* A,
    whose derivative is the mean. Energies are :math:`E = -f \cdot x - \log \mu(x)`. An inverse temperature
    multiplies the field and leaves the measure: at zero a unit follows :math:`\mu` alone.

    A layer has *sites*, each of one or more *entries*: a categorical unit of q states is one site of q entries.
    A kind of one's own is a subclass with ``mean``, ``sample``, ``mode``, ``cumulant`` and ``bias_of``;
    what it does not define is refused by name where it is asked for. Parameters of its own carry the replica axes
    in front.

    Attributes:
        n: Number of entries.
        linear: Whether the measure is constant over the values, so that means stand for expectations of E.
        real: Whether the values are real numbers, of which there is no list.
    """

    linear: ClassVar[bool] = True
    real: ClassVar[bool] = False

    def __init__(self, n: int) -> None:
        super().__init__()
        require_count(f"number of {type(self).__name__} units", n, minimum=0)
        self.n = n

    def extra_repr(self) -> str:
        """The size, as ``print`` shows it."""
        return str(self.n)

    @property
    def n_sites(self) -> int:
        """Number of units that are drawn independently, given the fields."""
        return self.n

    # ------------------------------------------------------------------------------------ given the fields

    @abstractmethod
    def mean(self, field: Values) -> Values:
        """E[x | field]."""

    @abstractmethod
    def sample(self, field: Values, *, generator: Generator) -> Values:
        """Draw x given the field."""

    @abstractmethod
    def mode(self, field: Values) -> Values:
        """The likeliest x given the field."""

    @abstractmethod
    def cumulant(self, field: Values) -> PerSite:
        """A(field): log of the sum over the values of a site of mu(x) exp(field . x)."""

    def sample_of_mean(self, mean: Values, *, generator: Generator) -> Values | None:
        """Draw x given its mean, where that says all; None where it does not."""
        return None

    def points(self, field: Values) -> list[Values]:
        """Values of equal weight whose mean energy is the expected one: the mean, if the measure is constant."""
        return [self.mean(field)]

    def negative_entropy(self, mean: Values) -> Float[Tensor, "*axes"]:
        """Sum over the values of p log p of independent units with these means, in nats."""
        raise self._without("entropy that follows from means")

    def cumulant_gain(self, field: Values, beta: float, target: float) -> Float[Tensor, "*axes"]:
        """A(target * field) - A(beta * field), summed over the sites, in float64."""
        wide = field.double()
        return (self.cumulant(target * wide) - self.cumulant(beta * wide)).sum(-1)

    # -------------------------------------------------------------------------------------------- measure

    def total_energy(self, x: Values, weight: Float[Tensor, "*axes"]) -> Float[Tensor, "*replicas"]:
        """Weighted sum of ``energy`` over the rows of x, ``(*replicas, n_rows, n)``, constants to autograd."""
        return (weight.detach() * self.energy(x.detach())).sum(-1)

    @property
    def curvature(self) -> Tensor | None:
        """Precision of each entry, ``(*replicas, n)``, where mu is ``exp(-curvature x^2 / 2)``, else None."""
        return None

    def site_energies(self, x: Values) -> PerSite:
        r"""``-log \mu`` of each site, where the kind is not ``linear``."""
        raise self._without("energies of their own")

    def energy(self, x: Values) -> Float[Tensor, "*axes"]:
        r"""``-log \mu(x)``, the part of E that no field multiplies."""
        return x.new_zeros(x.shape[:-1]) if self.linear else self.site_energies(x).sum(-1)

    @torch.no_grad()
    def project(self) -> None:
        """Bring the kind's own parameters back to where they are allowed, after a step of an optimiser."""

    # --------------------------------------------------------------------------------------- data and bits

    def check(
        self, v: Values, observed: Bool[Tensor, "*axes n"] | None = None, *, pure: bool = False, column: int = 0
    ) -> None:
        """Raise a SettingError for values that these units do not take, where they are observed.

        Args:
            v: Data.
            observed: Where they are known; None is everywhere.
            pure: Whether means, which stand for distributions over values, are refused as well.
            column: Number of the first site, for the error: a site is a column of the data.
        """

    def from_intensity(self, v: PerSite) -> Tensor:
        """Data, as they are kept, that stand for grey values in [0, 1]: one column a site."""
        raise self._without("a reading of grey values")

    def to_intensity(self, x: Values) -> PerSite:
        """Grey values that data, or their means, stand for: an affine function, for pictures."""
        raise self._without("a reading of grey values")

    def encode(self, kept: Tensor, *, check: bool = True, column: int = 0) -> Values:
        """Entries of data as they are kept, one column a site: the same, but for categories.

        Args:
            kept: Data, ``(..., n_sites)``.
            check: Whether numbers that are no state are looked for and refused.
            column: Number of the first site, for the error.
        """
        return kept

    def decode(self, v: Values) -> Tensor:
        """Data as they are kept, one column a site, of entries: the same, but for categories."""
        return v

    def values_of(self, mean: Values, *, generator: Generator) -> Values:
        """Draw values of data that may be means in between, as grey values are; real ones stay."""
        drawn = self.sample_of_mean(mean, generator=generator)
        return mean if drawn is None else drawn

    @abstractmethod
    def bias_of(self, total: Values, n: float | Tensor) -> Values:
        """The bias of units without couplings that have the means of n rows of this sum.

        Those of discrete units are drawn to the middle as by one more row of each value.
        """

    @torch.no_grad()
    def start(self, mean: Values, variance: Values, *, column: int = 0) -> None:
        """Set the kind's own parameters from means and variances of the data, ``(*replicas, n)``.

        ``column`` is the number of the first site, for the error.
        """

    def states(self, numbers: Int[Tensor, "*axes"], *, like: Tensor) -> Float[Tensor, "*axes n"]:
        """Values of the whole layer by their numbers, from 0 to ``n_states - 1``, in the dtype of ``like``."""
        raise self._without("a list of all its states")

    @property
    def n_states(self) -> int:
        """Number of states of the whole layer."""
        raise self._without("a list of all its states")

    def bits(self) -> Bits:
        """How the layer is written in bits for a QUBO; entries with a curvature may be left out."""
        remedy = "Samplers that need none: cd, pcd, parallel_tempering, block_annealing."
        raise self._without("a form in bits, as QUBOs and pseudo-likelihoods need it", remedy)

    # -------------------------------------------------------------------------------------------- entries

    def site_of(self) -> Tensor:
        """The site of each entry, ``(n,)`` int64, on the CPU."""
        return torch.arange(self.n, device="cpu")

    def real_entries(self) -> Tensor:
        """Which entries are real numbers, ``(n,)`` bool, on the CPU."""
        return torch.full((self.n,), self.real, device="cpu")

    def over_sites(self, of_sites: Tensor) -> Tensor:
        """Give each entry what its site has: ``(..., n_sites)`` to ``(..., n)``."""
        return of_sites

    def site_sums(self, x: Values) -> PerSite:
        """Sums over the entries of each site."""
        return x

    def zero_sum(self, x: Values) -> Values:
        """Numbers of entries in the zero-sum gauge: those of categorical sites less their mean over the site."""
        return x

    def select(self, entries: Tensor) -> "Units":
        """A layer of some entries, whole sites in rising order, with copies of the kind's own settings.

        Parameters and buffers with a number for each entry, ``(*replicas, n)``, keep those of these entries.
        """
        part = copy.deepcopy(self)
        part.n = len(entries)
        for name, parameter in list(part.named_parameters(recurse=False)):
            if parameter.shape[-1:] == (self.n,):
                setattr(part, name, nn.Parameter(parameter.detach()[..., entries], requires_grad=False))
        for name, buffer in list(part.named_buffers(recurse=False)):
            if buffer.shape[-1:] == (self.n,):
                setattr(part, name, buffer[..., entries])
        return part

    def beside(self, other: "Units") -> "Units | None":
        """One layer of this one and another after it, where that is of the same kind; else None."""
        return None

    def for_replicas(self, replicas: tuple[int, ...]) -> Self:
        """A copy for a model with these leading axes."""
        made = copy.deepcopy(self)
        for module in made.modules():
            for name, parameter in list(module.named_parameters(recurse=False)):
                setattr(module, name, nn.Parameter(_with_axes(parameter.detach(), replicas)))
            for name, buffer in list(module.named_buffers(recurse=False)):
                if buffer.is_floating_point():
                    setattr(module, name, _with_axes(buffer, replicas))
        return made

    def _without(self, what: str, remedy: str = "") -> SettingError:
        message = f"units = {type(self).__name__!r} is not allowed: expected units with {what}. {remedy}"
        return SettingError(message.rstrip())


def require_values(
    v: Values,
    allowed_at: Tensor,
    observed: Tensor | None,
    first_column: int,
    allowed: str,
    remedy: str = "",
    site_of: Tensor | None = None,
) -> None:
    """Raise a SettingError that names the first column with a value that is not allowed.

    ``site_of`` has the column of each entry, counted from the first one; None is one each.
    """
    wrong = ~allowed_at if observed is None else ~allowed_at & observed
    if bool(wrong.any()):
        *rows, entry = place = wrong.nonzero()[0].tolist()
        column = entry if site_of is None else int(site_of[entry])
        require(False, f"v {at_place([*rows, column], first_column)}", float(v[tuple(place)]), allowed, remedy)


def at_place(place: Sequence[int], first_column: int) -> str:
    """Where a value of data stands, for errors: indices ``(*axes, row, column)``, or a column alone."""
    row = f", row {place[-2]}" if len(place) > 1 else ""
    return f"in column {first_column + place[-1]}{row}"


def _with_axes(x: Tensor, replicas: tuple[int, ...]) -> Tensor:
    """A copy with these leading axes, which it may have already."""
    has_them = x.ndim > len(replicas) and tuple(x.shape[: len(replicas)]) == replicas
    return x.clone() if has_them else x.expand(*replicas, *x.shape).clone()


def all_states(units: Units, like: Tensor) -> Float[Tensor, "states n"]:
    """All values of a layer, in the order of their numbers."""
    return units.states(torch.arange(units.n_states, device=like.device), like=like)
