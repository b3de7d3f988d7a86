"""What is missing of each site of some rows, in the numbers that rows are kept in."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning.data.schema import Schema
from memcomp_lightning.likelihood.missing import Conditional
from memcomp_lightning.likelihood.missing.base import real_entries
from memcomp_lightning.models.sites import Site, sites_of
from memcomp_lightning.models.units import Units


class SiteGaps(NamedTuple):
    """What is missing of one site, in the rows where it is missing.

    Numbers are those that ``Rows.v`` has: states of categories, deviations of real columns.

    Attributes:
        site: Its number.
        row: Numbers of the rows, from 0, ``(n_gaps,)``.
        value: What is filled in: the likeliest value, of real sites and of grey values the mean.
        draws: Values drawn, those of one row jointly, ``(m, n_gaps)``.
        states: What a discrete site may be, ``(n_states,)``; None of a real one.
        probability: That of each of these, ``(n_gaps, n_states)``; None of a real one.
        deviation: Standard deviation of a real site, ``(n_gaps,)``; None of a discrete one.
        low: Where the interval begins that holds a real value with 90 %.
        high: Where it ends.
    """

    site: int
    row: Tensor
    value: Tensor
    draws: Tensor
    states: Tensor | None = None
    probability: Tensor | None = None
    deviation: Tensor | None = None
    low: Tensor | None = None
    high: Tensor | None = None

    @property
    def of_value(self) -> Tensor:
        """Probability of what is filled in, ``(n_gaps,)``; NaN of real sites, and of grey values in between."""
        if self.states is None or self.probability is None:
            return torch.full_like(self.value, torch.nan)
        exact, at = (self.value.unsqueeze(-1) - self.states).abs().min(-1)
        found = self.probability.gather(-1, at.unsqueeze(-1)).squeeze(-1)
        return torch.where(exact == 0, found, torch.nan)


class Reading(NamedTuple):
    """How values of visible units are read as numbers of sites.

    Attributes:
        units: The visible units.
        sites: Of them.
        column: Number of each real entry among the real ones.
        of_images: Whether numbers are grey values.
        grey: Which sites have means as numbers.
    """

    units: Units
    sites: list[Site]
    column: dict[int, int]
    of_images: bool
    grey: list[bool]

    @classmethod
    def of(cls, schema: Schema, units: Units) -> "Reading":
        """The one of a schema."""
        column = {entry: k for k, entry in enumerate(real_entries(units).tolist())}
        kinds = [getattr(column, "kind", "") for column in getattr(schema, "of_sites", ())]
        of_images = schema.units() is None
        grey = [kind == "probability" for kind in kinds] or [of_images] * schema.n_sites
        return cls(units, sites_of(units), column, of_images, grey)

    def gaps(self, rows: Tensor, observed: Tensor, found: Conditional) -> Iterator[tuple[int, SiteGaps]]:
        """What is missing of each site."""
        means, draws = self._numbers(found.mean), self._numbers(found.draws)
        for k, site in enumerate(self.sites):
            at = (~observed[:, site.entries[0]]).nonzero().flatten()
            if not len(at):
                continue
            gaps = SiteGaps(k, rows[at], means[at, k], draws[:, at, k])
            if site.numbers is None:
                deviation, low, high = found.real[:, at, self.column[site.entries[0]]].float()
                yield k, gaps._replace(deviation=deviation, low=low, high=high)
                continue
            probability, n = site.probabilities(found.mean[at]).float(), len(site.numbers)
            states = torch.linspace(0, 1, n) if self.of_images else torch.tensor(site.numbers)
            value = gaps.value if self.grey[k] else states[probability.argmax(-1)]
            yield k, gaps._replace(value=value, states=states, probability=probability)

    def _numbers(self, x: Tensor) -> Tensor:
        """Values or means of the units as numbers of the sites, ``(..., n_sites)`` float32."""
        if self.of_images:
            return self.units.to_intensity(x).float()
        found = [
            x[..., site.entries].argmax(-1) if site.is_category else x[..., site.entries[0]] for site in self.sites
        ]
        return torch.stack([column.float() for column in found], dim=-1)


def joined(parts: Sequence[SiteGaps]) -> SiteGaps:
    """The gaps of one site, in the order of the rows."""
    order = torch.cat([part.row for part in parts]).argsort()

    def together(columns: list[Tensor | None]) -> Tensor | None:
        there = [column for column in columns if column is not None]
        return torch.cat(there)[order] if there else None

    return SiteGaps(
        parts[0].site,
        torch.cat([part.row for part in parts])[order],
        torch.cat([part.value for part in parts])[order],
        torch.cat([part.draws for part in parts], dim=-1)[:, order],
        parts[0].states,
        together([part.probability for part in parts]),
        together([part.deviation for part in parts]),
        together([part.low for part in parts]),
        together([part.high for part in parts]),
    )
