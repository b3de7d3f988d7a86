"""Units of several states, as one-hot blocks."""

import math
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.units.base import Bits, PerSite, Units, Values, at_place, require_values

_ENCODE = "Make entries of numbers of states by the units' encode."


class Categorical(Units):
    r"""Potts units: a site of q states has q entries, of which one is 1; :math:`A(f) = \log \sum_a e^{f_a}`.

    Data are kept as numbers of states, ``encode`` makes entries of them. The sites stand side by side, the q of a
    site with :func:`~memcomp_lightning.models.zero_sum` adding up to zero: adding a number to all fields of a site
    changes nothing, and this *gauge* takes it away.

    Args:
        n_sites: Number of sites, >= 1; or, without ``q``, the number of states of each site.
        q: States of every site, >= 1.

    Attributes:
        sizes: States of each site.

    >>> Categorical([2, 3]).encode(torch.tensor([[1, 0]])).tolist()
    [[0.0, 1.0, 1.0, 0.0, 0.0]]
    """

    def __init__(
        self, n_sites: int | Sequence[int] | Tensor | NDArray[np.integer[Any]], q: int | None = None
    ) -> None:
        if isinstance(n_sites, Sequence | Tensor | np.ndarray):
            require(q is None, "q", q, "None where the number of states of each site is given")
            given = n_sites if isinstance(n_sites, Sequence) else n_sites.tolist()
            for site, size in enumerate(given):
                require_count(f"number of states of site {site}", size)
            sizes = [int(size) for size in given]
        else:
            require_count("n_sites", n_sites, minimum=0)
            require(q is not None, "q", q, "the number of states of every site, an integer >= 1")
            require_count("q", q)
            assert q is not None
            sizes = [int(q)] * int(n_sites)
        super().__init__(sum(sizes))
        self.sizes = tuple(sizes)
        widest = max(sizes, default=1)
        self._q = widest if all(size == widest for size in sizes) else None
        sites = torch.repeat_interleave(
            torch.arange(len(sizes), device="cpu"), torch.tensor(sizes, dtype=torch.long, device="cpu")
        )
        begins = torch.tensor(list(accumulate([0, *sizes[:-1]])) if sizes else [], dtype=torch.long, device="cpu")
        self._on_the_cpu = sites
        self._site: Tensor
        self._begin: Tensor
        self._slot: Tensor
        self._sizes: Tensor
        self.register_buffer("_site", sites, persistent=False)
        self.register_buffer("_begin", begins, persistent=False)
        self.register_buffer("_sizes", torch.tensor(sizes, dtype=torch.long, device="cpu"), persistent=False)
        # Where each entry goes in a table (n_sites, widest) with empty places.
        slot = sites * widest + torch.arange(self.n, device="cpu") - begins[sites] if sizes else sites
        self.register_buffer("_slot", slot, persistent=False)
        self._widest = widest

    def extra_repr(self) -> str:
        """The sizes, as ``print`` shows them."""
        return f"{self.n_sites}, q={self._q}" if self._q else str(list(self.sizes))

    @property
    def n_sites(self) -> int:
        """Number of sites."""
        return len(self.sizes)

    def _table(self, x: Tensor, empty: float) -> Tensor:
        """``(..., n)`` as ``(..., n_sites, widest)``."""
        if self._q is not None:
            return x.unflatten(-1, (self.n_sites, self._q)) if self.n else x.new_zeros(*x.shape[:-1], 0, 1)
        flat = x.new_full((*x.shape[:-1], self.n_sites * self._widest), empty)
        table: Tensor = flat.index_copy(-1, self._slot, x).unflatten(-1, (self.n_sites, self._widest))
        return table

    def _flat(self, table: Tensor) -> Tensor:
        """``(..., n_sites, widest)`` as ``(..., n)``."""
        flat = table.flatten(-2)
        return flat if self._q is not None else flat[..., self._slot]

    def _one_hot(self, index: Tensor, like: Tensor) -> Tensor:
        """``(..., n_sites)`` states as entries."""
        entries = like.new_zeros(*index.shape[:-1], self.n)
        return entries.scatter_(-1, index + self._begin, 1.0)

    def mean(self, field: Values) -> Values:
        """Probability of each state: the softmax of the fields of a site."""
        return self._flat(torch.softmax(self._table(field, -torch.inf), dim=-1))

    def sample(self, field: Values, *, generator: Generator) -> Values:
        """Draw a state a site, by inversion."""
        table = self._table(field, -torch.inf)
        if _need_no_shift(field):
            return self._drawn(torch.exp(table), field, generator)
        share = torch.exp_(table - table.amax(-1, keepdim=True))
        return self._drawn(share, field, generator)

    def sample_of_mean(self, mean: Values, *, generator: Generator) -> Values:
        """Draw a state a site; the means are the probabilities."""
        return self._drawn(self._table(mean, 0.0), mean, generator)

    def _drawn(self, share: Tensor, like: Tensor, generator: Generator) -> Tensor:
        """Draw a state a site of shares ``(..., n_sites, widest)``."""
        below = share.cumsum(-1)
        u = rng.uniform(share.shape[:-1], generator=generator, like=like) * below[..., -1]
        # The first state whose sum is above u: a state of share zero is never drawn.
        index = torch.searchsorted(below, u.unsqueeze(-1), right=True).squeeze(-1)
        return self._one_hot(index.minimum(self._last(like)), like)

    def _last(self, like: Tensor) -> Tensor:
        """Number of the last state of each site, on the device of the data."""
        return self._sizes.to(like.device) - 1

    def mode(self, field: Values) -> Values:
        """The state of the largest field."""
        return self._one_hot(self._table(field, -torch.inf).argmax(-1), field)

    def cumulant(self, field: Values) -> PerSite:
        """Log of the sum of exp(field) over the states of each site."""
        return torch.logsumexp(self._table(field, -torch.inf), dim=-1)

    def negative_entropy(self, mean: Values) -> Tensor:
        """Sum of p log p over the states."""
        total: Tensor = torch.special.xlogy(mean, mean).sum(-1)
        return total

    def check(self, v: Values, observed: Tensor | None = None, *, pure: bool = False, column: int = 0) -> None:
        """Entries are in [0, 1] and add up to one in each site: between 0 and 1 they are probabilities."""
        allowed_at, values = ((v == 0) | (v == 1), "{0, 1}") if pure else ((v >= 0) & (v <= 1), "[0, 1]")
        allowed = f"entries in {values} for categorical units"
        require_values(v, allowed_at, observed, column, allowed, _ENCODE, site_of=self._on_the_cpu)
        sums = self.site_sums(v)
        seen = None if observed is None else self._table(observed, False).any(-1)
        wrong = (sums - 1).abs() > 1e-3 if seen is None else ((sums - 1).abs() > 1e-3) & seen
        if bool(wrong.any()):
            place = wrong.nonzero()[0].tolist()
            name = f"entries together {at_place(place, column)}"
            require(False, name, float(sums[tuple(place)]), "entries that add up to 1", _ENCODE)

    def bias_of(self, total: Values, n: float | Tensor) -> Values:
        """Log of the counts plus one, less its mean over the states of a site."""
        return self.zero_sum(torch.log(total + 1))

    def zero_sum(self, x: Values) -> Values:
        """Entries less their mean over the states of their site."""
        return x - self.over_sites(self.site_sums(x) / self._sizes)

    def from_intensity(self, v: PerSite) -> Tensor:
        """Numbers of states: levels of grey from 0, black, to q - 1, white; a byte each where that is enough."""
        numbers = (v * self._last(v)).round()
        return numbers.to(torch.uint8 if self._widest <= 256 else torch.long)

    def to_intensity(self, x: Values) -> PerSite:
        """The mean level of each site over q - 1."""
        level = torch.arange(self.n, device=x.device) - self._begin[self._site]
        return self.site_sums(x * level / self.over_sites(self._last(x).clamp(min=1)))

    def encode(self, states: Tensor, *, check: bool = True, column: int = 0) -> Tensor:
        """Entries of numbers of states, ``(..., n_sites)`` to ``(..., n)`` float32.

        Raises:
            SettingError: A number that is no state of its site.
        """
        like = torch.empty(0, dtype=torch.float32, device=states.device)
        if not check:
            return self._one_hot(states.long(), like)
        fits = states.ndim >= 1 and states.shape[-1] == self.n_sites
        require(fits, "shape of states", tuple(states.shape), f"(..., {self.n_sites})")
        index = states.long()
        wrong = (index < 0) | (index >= self._sizes) | (index != states)
        if bool(wrong.any()):
            place = wrong.nonzero()[0].tolist()
            size = self.sizes[place[-1]]
            name, allowed = f"state {at_place(place, column)}", f"an integer from 0 to q - 1 = {size - 1}"
            require(False, name, states[tuple(place)].item(), allowed)
        return self._one_hot(index, like)

    def decode(self, v: Values) -> Tensor:
        """The likeliest state of each site, ``(..., n)`` to ``(..., n_sites)`` int64."""
        return self._table(v, -torch.inf).argmax(-1)

    def states(self, numbers: Tensor, *, like: Tensor) -> Tensor:
        """Numbers of mixed radix, the first site counting slowest."""
        digits = []
        for size in reversed(self.sizes):
            digits.append(numbers % size)
            numbers = numbers // size
        if not digits:
            return like.new_zeros(*numbers.shape, 0)
        return self._one_hot(torch.stack(digits[::-1], dim=-1), like)

    @property
    def n_states(self) -> int:
        """Product of the numbers of states."""
        return math.prod(self.sizes)

    def bits(self) -> Bits:
        """A bit a state, exactly one of them on in each site."""
        groups = [list(range(b, b + size)) for b, size in zip(self._begin.tolist(), self.sizes, strict=True)]
        return Bits(
            torch.arange(self.n, device="cpu"),
            torch.zeros(self.n, device="cpu"),
            torch.ones(self.n, device="cpu"),
            groups,
        )

    def site_of(self) -> Tensor:
        """The site of each entry."""
        return self._on_the_cpu

    def over_sites(self, of_sites: Tensor) -> Tensor:
        """Give each entry what its site has."""
        return of_sites[..., self._site]

    def site_sums(self, x: Values) -> PerSite:
        """Sums over the states of each site."""
        return self._table(x, 0.0).sum(-1)

    def select(self, entries: Tensor) -> "Categorical":
        """Some of the sites."""
        sites = self._site[entries].unique_consecutive().tolist()
        part = Categorical([self.sizes[site] for site in sites])
        require(part.n == len(entries), "number of entries", len(entries), f"{part.n}, those of whole sites")
        return part.to(self._site.device)

    def beside(self, other: Units) -> "Categorical | None":
        """The sites of both."""
        if not isinstance(other, Categorical):
            return None
        return Categorical([*self.sizes, *other.sizes]).to(self._site.device)


def _need_no_shift(field: Tensor) -> bool:
    """Whether exp(field) is far from overflow and zero; asked on the CPU alone, as other devices would wait."""
    if field.device.type != "cpu" or not field.numel():
        return False
    low, high = torch.aminmax(field.detach())
    # Of NaN and of infinite fields this is False.
    return float(torch.maximum(-low, high)) < math.log(torch.finfo(field.dtype).max) / 2
