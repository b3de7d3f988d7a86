"""Units of several kinds side by side, as the columns of a table."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Generator, Tensor, nn

from memcomp_lightning.errors import require
from memcomp_lightning.models.units.base import Bits, PerSite, Units, Values


class Mixed(Units):
    """Layers of several kinds, one after the other, in one model.

    Args:
        parts: The kinds, in the order of their entries.

    >>> from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian
    >>> Mixed(Bernoulli(2), Categorical([3, 4]), Gaussian(1)).n
    10
    """

    def __init__(self, *parts: Units) -> None:
        require(bool(parts), "parts of mixed units", len(parts), "one kind of units or more")
        for part in parts:
            require(
                isinstance(part, Units), "part of mixed units", part, "a kind of memcomp_lightning.models.units"
            )
        super().__init__(sum(part.n for part in parts))
        self.parts = nn.ModuleList(parts)
        self._sizes = [part.n for part in parts]

    def extra_repr(self) -> str:
        """Nothing beside the parts."""
        return ""

    @property
    def kinds(self) -> list[Units]:
        """The parts."""
        return list(self.parts)  # type: ignore[arg-type]

    @property
    def linear(self) -> bool:  # type: ignore[override]
        """Whether the measure of every part is constant."""
        return all(kind.linear for kind in self.kinds)

    @property
    def real(self) -> bool:  # type: ignore[override]
        """Whether one of the parts is real."""
        return any(kind.real for kind in self.kinds)

    @property
    def n_sites(self) -> int:
        """Sites of all parts."""
        return sum(kind.n_sites for kind in self.kinds)

    def _each(self, function: Callable[[Units, Tensor], Tensor], x: Tensor) -> Tensor:
        """Apply a function of a kind and its entries, and put the results side by side."""
        return torch.cat([function(k, part) for k, part in zip(self.kinds, self._split(x), strict=True)], dim=-1)

    def _split(self, x: Tensor) -> tuple[Tensor, ...]:
        parts: tuple[Tensor, ...] = x.split(self._sizes, dim=-1)
        return parts

    def mean(self, field: Values) -> Values:
        """Of each part."""
        return self._each(lambda kind, part: kind.mean(part), field)

    def sample(self, field: Values, *, generator: Generator) -> Values:
        """Of each part, drawn one after the other."""
        return self._each(lambda kind, part: kind.sample(part, generator=generator), field)

    def sample_of_mean(self, mean: Values, *, generator: Generator) -> Values | None:
        """Of each part, if all have it."""
        parts = zip(self.kinds, self._split(mean), strict=True)
        drawn = [kind.sample_of_mean(part, generator=generator) for kind, part in parts]
        known = [part for part in drawn if part is not None]
        return torch.cat(known, dim=-1) if len(known) == len(drawn) else None

    def mode(self, field: Values) -> Values:
        """Of each part."""
        return self._each(lambda kind, part: kind.mode(part), field)

    def cumulant(self, field: Values) -> PerSite:
        """Of each part."""
        return self._each(lambda kind, part: kind.cumulant(part), field)

    def points(self, field: Values) -> list[Values]:
        """Those of the parts, side by side, as no energy couples two parts."""
        found = [kind.points(part) for kind, part in zip(self.kinds, self._split(field), strict=True)]
        n = math.lcm(*map(len, found))
        return [torch.cat([points[k % len(points)] for points in found], dim=-1) for k in range(n)]

    def cumulant_gain(self, field: Values, beta: float, target: float) -> Tensor:
        """The sum of the parts'."""
        parts = zip(self.kinds, self._split(field), strict=True)
        return torch.stack([kind.cumulant_gain(part, beta, target) for kind, part in parts]).sum(0)

    def negative_entropy(self, mean: Values) -> Tensor:
        """The sum of the parts'."""
        found = [kind.negative_entropy(part) for kind, part in zip(self.kinds, self._split(mean), strict=True)]
        return torch.stack(found).sum(0)

    @property
    def curvature(self) -> Tensor | None:
        """Of each part, zero where it has none."""
        found = [kind.curvature for kind in self.kinds]
        like = next((one for one in found if one is not None), None)
        if like is None:
            return None
        wide = [
            like.new_zeros(*like.shape[:-1], kind.n) if one is None else one
            for kind, one in zip(self.kinds, found, strict=True)
        ]
        return torch.cat(wide, dim=-1)

    def site_energies(self, x: Values) -> PerSite:
        """Of each part, zero where its measure is constant."""

        def of_part(kind: Units, part: Tensor) -> Tensor:
            if kind.linear:
                return part.new_zeros(*part.shape[:-1], kind.n_sites)
            return kind.site_energies(part)

        return self._each(of_part, x)

    def energy(self, x: Values) -> Tensor:
        """The sum of the parts'."""
        energies = [kind.energy(part) for kind, part in zip(self.kinds, self._split(x), strict=True)]
        return torch.stack(energies).sum(0)

    def total_energy(self, x: Values, weight: Tensor) -> Tensor:
        """The sum of the parts'."""
        totals = [kind.total_energy(part, weight) for kind, part in zip(self.kinds, self._split(x), strict=True)]
        return torch.stack(totals).sum(0)

    def project(self) -> None:
        """Each part."""
        for kind in self.kinds:
            kind.project()

    def check(self, v: Values, observed: Tensor | None = None, *, pure: bool = False, column: int = 0) -> None:
        """Each part."""
        masks = [None] * len(self.kinds) if observed is None else self._split(observed)
        for kind, part, mask in zip(self.kinds, self._split(v), masks, strict=True):
            kind.check(part, mask, pure=pure, column=column)
            column += kind.n_sites

    def encode(self, kept: Tensor, *, check: bool = True, column: int = 0) -> Values:
        """Of each part."""
        found = []
        for kind, part in zip(self.kinds, kept.split([kind.n_sites for kind in self.kinds], dim=-1), strict=True):
            found.append(kind.encode(part, check=check, column=column))
            column += kind.n_sites
        return torch.cat(found, dim=-1)

    def decode(self, v: Values) -> Tensor:
        """Of each part, in the dtype of v."""
        return self._each(lambda kind, part: kind.decode(part).to(v.dtype), v)

    def values_of(self, mean: Values, *, generator: Generator) -> Values:
        """Of each part."""
        return self._each(lambda kind, part: kind.values_of(part, generator=generator), mean)

    def bias_of(self, total: Values, n: float | Tensor) -> Tensor:
        """Of each part."""
        counts: Sequence[float | Tensor] = self._split(n) if isinstance(n, Tensor) else [n] * len(self.kinds)
        parts = zip(self.kinds, self._split(total), counts, strict=True)
        biases = [kind.bias_of(part, count) for kind, part, count in parts]
        # Precisions have the replica axis, data need not have it.
        axes = torch.broadcast_shapes(*(bias.shape[:-1] for bias in biases))
        return torch.cat([bias.expand(*axes, -1) for bias in biases], dim=-1)

    def start(self, mean: Values, variance: Values, *, column: int = 0) -> None:
        """Each part."""
        for kind, *parts in zip(self.kinds, self._split(mean), self._split(variance), strict=True):
            kind.start(*parts, column=column)
            column += kind.n_sites

    def states(self, numbers: Tensor, *, like: Tensor) -> Tensor:
        """Those of all parts, the first part counting slowest."""
        found = []
        for kind in reversed(self.kinds):
            found.append(kind.states(numbers % kind.n_states, like=like))
            numbers = numbers // kind.n_states
        return torch.cat(found[::-1], dim=-1)

    @property
    def n_states(self) -> int:
        """Product over the parts."""
        return math.prod(kind.n_states for kind in self.kinds)

    def bits(self) -> Bits:
        """Those of all parts, one after the other."""
        at, low, width, groups, entry, bit = [], [], [], [], 0, 0
        for kind in self.kinds:
            own = kind.bits()
            at.append(own.at + entry)
            low.append(own.low)
            width.append(own.width)
            groups += [[bit + one for one in group] for group in own.groups]
            entry, bit = entry + kind.n, bit + len(own.at)
        return Bits(torch.cat(at), torch.cat(low), torch.cat(width), groups)

    def site_of(self) -> Tensor:
        """The site of each entry, counted over all parts."""
        found, n = [], 0
        for kind in self.kinds:
            found.append(kind.site_of() + n)
            n += kind.n_sites
        return torch.cat(found)

    def real_entries(self) -> Tensor:
        """Those of the real parts."""
        return torch.cat([kind.real_entries() for kind in self.kinds])

    def over_sites(self, of_sites: Tensor) -> Tensor:
        """Give each entry what its site has."""
        parts = of_sites.split([kind.n_sites for kind in self.kinds], dim=-1)
        return torch.cat([kind.over_sites(part) for kind, part in zip(self.kinds, parts, strict=True)], dim=-1)

    def site_sums(self, x: Values) -> PerSite:
        """Of each part."""
        return self._each(lambda kind, part: kind.site_sums(part), x)

    def zero_sum(self, x: Values) -> Values:
        """Of each part."""
        return self._each(lambda kind, part: kind.zero_sum(part), x)

    def select(self, entries: Tensor) -> Units:
        """Some of the sites, of whichever parts."""
        found, begin = [], 0
        for kind in self.kinds:
            own = entries[(entries >= begin) & (entries < begin + kind.n)] - begin
            found.append(kind.select(own))
            begin += kind.n
        return side_by_side(*found)


def side_by_side(*layers: Units) -> Units:
    """Several layers as one; neighbours of one kind become one part, empty layers are left out."""
    parts: list[Units] = []
    for layer in layers:
        for kind in layer.kinds if isinstance(layer, Mixed) else [layer]:
            together = parts[-1].beside(kind) if parts else None
            if together is not None:
                parts[-1] = together
            elif kind.n:
                parts.append(kind)
    if not parts:
        return layers[0]
    return parts[0] if len(parts) == 1 else Mixed(*parts)
