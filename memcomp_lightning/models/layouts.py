"""Where couplings stand: classes of units that are drawn at once, with a matrix for each."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from memcomp_lightning.models.connectivity import Pairs, colouring


class Layout(NamedTuple):
    """Where the couplings of a block go: number ``edge`` of the list into ``slot`` of its flat matrix.

    The first ``n_forward`` have their other end in a later block: all blocks together have each pair once there.
    """

    units: Tensor
    neighbours: Tensor
    edge: Tensor
    slot: Tensor
    n_forward: int


INDICES = ("units", "neighbours", "edge", "slot")
"""Tensors of a :class:`Layout`."""


def classes_of(n_sites: int, pairs: Pairs, real: Tensor) -> list[Tensor]:
    """Classes of sites without couplings inside; real ones are in one, as no other class has a list of states."""
    classes = colouring(n_sites, pairs)
    if sum(bool(torch.isin(sites, real).any()) for sites in classes) <= 1:
        return classes
    number = torch.arange(n_sites, device="cpu")
    number[real] = real[0]
    ends, _ = number[pairs].sort(dim=-1)
    apart = colouring(n_sites, ends.unique(dim=0))
    found = []
    for sites in apart:
        own = sites[~torch.isin(sites, real)]
        found.append(torch.cat((own, real)).sort().values if bool((sites == real[0]).any()) else own)
    return [sites for sites in found if len(sites)]


def layouts_of(n_units: int, pairs: Pairs, classes: Sequence[Tensor]) -> list[Layout]:
    """One layout a class: the couplings of its units, those to later classes first."""
    colour, place = pairs.new_empty(n_units), pairs.new_empty(n_units)
    for number, units in enumerate(classes):
        colour[units], place[units] = number, torch.arange(len(units), device=pairs.device)
    found = []
    for number, units in enumerate(classes):
        ends, edges = [], []
        for here, there in ((0, 1), (1, 0)):
            edge = (colour[pairs[:, here]] == number).nonzero().flatten()
            ends.append(torch.stack((pairs[edge, here], pairs[edge, there]), dim=-1))
            edges.append(edge)
        end, edge = torch.cat(ends), torch.cat(edges)
        forward = colour[end[:, 1]] > number
        order = forward.to(torch.int8).argsort(descending=True, stable=True)
        end, edge = end[order], edge[order]
        neighbours, column = end[:, 1].unique(return_inverse=True)
        slot = place[end[:, 0]] * len(neighbours) + column
        found.append(Layout(units, neighbours, edge, slot, int(forward.sum())))
    return found


def of_entries(site_pairs: Pairs, site_of: Tensor, n_sites: int) -> Int[Tensor, "n_entry_pairs 2"]:
    """Pairs of entries, all of one site with all of the other, in ascending order."""
    if len(site_of) == n_sites:
        return site_pairs
    entries = torch.arange(len(site_of), device="cpu").split(torch.bincount(site_of, minlength=n_sites).tolist())
    found = torch.cat(
        [site_pairs[:0], *(torch.cartesian_prod(entries[i], entries[j]) for i, j in site_pairs.tolist())]
    )
    return found[(found[:, 0] * len(site_of) + found[:, 1]).argsort()]
