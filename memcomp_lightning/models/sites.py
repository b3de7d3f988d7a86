"""The states of each discrete site of a layer, as tensors."""

from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning.arrays import moved
from memcomp_lightning.models.units import Units


class DiscreteSites(NamedTuple):
    """What each site may be, padded to the widest one; real units have no states and are left out.

    Attributes:
        at: Numbers of these sites in the layer, ``(n_sites,)``.
        entries: Entries of each site, ``(n_sites, widest)``; padded by its first one.
        low: Their low values, of the same shape; 0 where padded.
        width: What they gain at their high ones; 0 where padded.
        high: Which entry is high in each state, ``(n_sites, n_states, widest)`` of 0 and 1; a state that a site
            lacks is as its first one.
        exists: Which states there are, ``(n_sites, n_states)`` bool.
    """

    at: Tensor
    entries: Tensor
    low: Tensor
    width: Tensor
    high: Tensor
    exists: Tensor

    @classmethod
    def of(cls, units: Units, *, like: Tensor) -> "DiscreteSites":
        """The sites of a layer, in the dtype and on the device of a tensor.

        Raises:
            SettingError: The units have no form in bits.
        """
        form = units.bits()
        sites = [*form.groups, *([bit] for bit in form.lone())]
        n_groups, widest = len(form.groups), max(map(len, sites), default=1)
        n_states = max(widest, 2) if len(sites) > n_groups else widest
        at, of_low, of_width = form.at.cpu(), form.low.to(like.dtype).cpu(), form.width.to(like.dtype).cpu()
        entries = torch.zeros(len(sites), widest, dtype=torch.long, device="cpu")
        low, width = torch.zeros(2, len(sites), widest, dtype=like.dtype, device="cpu")
        high = torch.zeros(len(sites), n_states, widest, dtype=like.dtype, device="cpu")
        exists = torch.zeros(len(sites), n_states, dtype=torch.bool, device="cpu")
        for number, site in enumerate(sites):
            size, some = len(site), torch.tensor(site, device="cpu")
            entries[number], entries[number, :size] = at[some[0]], at[some]
            low[number, :size], width[number, :size] = of_low[some], of_width[some]
            if number < n_groups:
                high[number, :, 0] = 1.0
                high[number, :size, :size] = torch.eye(size, dtype=like.dtype, device="cpu")
                exists[number, :size] = True
            else:
                high[number, 1, 0] = 1.0
                exists[number, :2] = True
        parts = units.site_of().cpu()[entries[:, 0]], entries, low, width, high, exists
        return cls(*(moved(part, like.device) for part in parts))

    @property
    def values(self) -> Tensor:
        """What the entries are in each state, ``(n_sites, n_states, widest)``."""
        return self.low.unsqueeze(-2) + self.width.unsqueeze(-2) * self.high


class Site(NamedTuple):
    """One site of a layer.

    Attributes:
        entries: Its entries.
        numbers: Data, as they are kept, of each of its states, those of a category being numbers from 0; None of a
            real unit.
    """

    entries: list[int]
    numbers: list[float] | None

    @property
    def is_category(self) -> bool:
        """Whether its states have an entry each."""
        return self.numbers is not None and len(self.numbers) == len(self.entries)

    def probabilities(self, mean: Tensor) -> Tensor:
        """Of its states, by the means of all entries of the layer, ``(n, n_entries)`` to ``(n, n_states)``."""
        own = mean[..., self.entries]
        if self.numbers is None or self.is_category:
            return own
        low, high = self.numbers
        share = (own - low) / (high - low)
        return torch.cat((1 - share, share), dim=-1)


def sites_of(units: Units) -> list[Site]:
    """The sites of a layer, in order.

    Raises:
        SettingError: The units have no form in bits.
    """
    form = units.bits()
    at, low, width = form.at.tolist(), form.low.tolist(), form.width.tolist()
    found = {
        at[group[0]]: Site([at[bit] for bit in group], [float(k) for k in range(len(group))])
        for group in form.groups
    }
    found |= {at[k]: Site([at[k]], [low[k], low[k] + width[k]]) for k in form.lone()}
    found |= {entry: Site([entry], None) for entry in units.real_entries().nonzero().flatten().tolist()}
    return [found[entry] for entry in sorted(found)]
