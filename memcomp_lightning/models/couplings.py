"""What a model has learned about its sites: couplings J, biases h, and scores of contacts."""

import copy
import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.boltzmann import BoltzmannMachine
from memcomp_lightning.models.gauge import zero_sum
from memcomp_lightning.models.pair_series import N_NODES, couplings_by_series
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.units import Units

NUMBERS = 2**22
"""Numbers of a table that are held at once."""


@dataclass(frozen=True, slots=True)
class Couplings:
    r"""Pairwise energies of the visible sites, :math:`E = -\sum_{i<j} x_i J_{ij} x_j - \sum_i h_i x_i`.

    Units in {0, 1} are read as spins: x = 2 v - 1. Categorical ones have an entry for each state, in the zero-sum
    gauge: J adds up to zero over the states of either site, h over those of one.

    Attributes:
        J: Symmetric, zero inside a site, ``(*replicas, n, n)`` with the entries of the visible units.
        h: ``(*replicas, n)``.
        units: The kind of the visible units.
    """

    J: Tensor
    h: Tensor
    units: Units

    def block(self, i: int, j: int) -> Float[Tensor, "*replicas q_i q_j"]:
        """J between two sites."""
        site_of = self.units.site_of()
        first, second = ((site_of == site).nonzero().flatten() for site in (i, j))
        return self.J[..., first.unsqueeze(-1), second]

    def by_states(self) -> tuple[Float[Tensor, "*replicas sites q sites q"], Float[Tensor, "*replicas sites q"]]:
        """J and h with an axis of the widest site's states; zero where a site has fewer."""
        at, n_sites, widest = _places(self.units)
        table = n_sites, widest
        of_sites = self.h.new_zeros(*self.h.shape[:-1], n_sites * widest)
        of_sites[..., at] = self.h
        of_pairs = self.J.new_zeros(*self.J.shape[:-2], n_sites * widest, n_sites * widest)
        of_pairs[..., at.unsqueeze(-1), at] = self.J
        return of_pairs.unflatten(-1, table).unflatten(-3, table), of_sites.unflatten(-1, table)


@torch.no_grad()
def couplings(model: RBM | BoltzmannMachine) -> Couplings:
    r"""Return J and h of the visible sites, in float64, in the zero-sum gauge; the model stays as it is.

    Of a Boltzmann machine without hidden units they are its own. Of an RBM they are the *effective* ones: the
    terms of one and two sites in the expansion of log p(v) into functions that add up to zero over the values of
    each of their sites. With the couplings w(a) of a hidden unit to a site in the state a, in the zero-sum gauge
    (for spins plus and minus w), and the cumulants A of the hidden units,

    .. math:: J_{jk}(a, b) = P_a P_b \sum_i \langle A_i(c_i + w_{ij}(a) + w_{ik}(b) + z) \rangle_z

    where P subtracts the mean over the states, and z is the field of all other sites, which are uniform and
    independent. Its distribution is taken as the normal one of their variance: exact for Gaussian hidden units and
    for two sites, and good for many sites of small weights (Decelle, Furtlehner, Navas Gomez & Seoane 2024,
    arXiv 2309.02292, for spins).

    Raises:
        SettingError: Real visible units; a machine with hidden units; categorical hidden units of an RBM.
    """
    allowed = "an RBM or a Boltzmann machine"
    fits = isinstance(model, RBM | BoltzmannMachine)
    require(fits, "model", type(model).__name__, allowed, "Of a DBN give a layer.")
    kind = type(model.visible).__name__
    require(not model.visible.real, "kind of the visible units", kind, "discrete units, for couplings")
    model = copy.deepcopy(model).double()
    zero_sum(model)
    low, width = _values(model.visible, model.b)
    middle, half = low + width / 2, width / 2
    if isinstance(model, RBM):
        n_sites, kind = model.hidden.n_sites, type(model.hidden).__name__
        require(n_sites == model.n_hidden, "kind of the hidden units", kind, "units of one entry each")
        c = model.c + (model.weight * middle).sum(-1)
        return _effective(model, model.weight * half, c, model.b * half)
    require(model.n_hidden == 0, "n_hidden", model.n_hidden, "0, or an RBM, for couplings of the visible sites")
    matrix = model.coupling.new_zeros(*model.replicas, model.n_units, model.n_units)
    matrix[..., model.pairs[:, 0], model.pairs[:, 1]] = model.coupling
    matrix = matrix + matrix.mT
    h = half * (model.b + (matrix * middle).sum(-1))
    return Couplings(half.unsqueeze(-1) * matrix * half, h, model.visible)


def contact_scores(
    model: RBM | BoltzmannMachine | Couplings, *, gap: int | None = None, corrected: bool = True
) -> Float[Tensor, "*replicas n_sites n_sites"]:
    r"""Return how strongly each two sites are coupled: what ranks contacts of proteins.

    .. math:: S_{ij} = \|J_{ij}\| - \frac{\bar S_i \bar S_j}{\bar S}

    with the Frobenius norm over the states in the zero-sum gauge, less the *average-product correction*, which
    takes away what a site has with all others: means over the other sites, and over all pairs (Dunn, Wahl & Gloor
    2008; with norms Ekeberg et al. 2013). Symmetric, zero on the diagonal, in float64.

    Args:
        model: An RBM or a Boltzmann machine, see :func:`couplings`; or what that returned.
        gap: Number of a state that stands for no letter: it counts in the gauge, and is left out of the norms.
        corrected: Whether to subtract the correction.
    """
    found = model if isinstance(model, Couplings) else couplings(model)
    units = found.units
    at, n_sites, widest = _places(units)
    counts = torch.ones(units.n, dtype=torch.bool, device="cpu")
    if gap is not None:
        require(0 <= gap < widest, "gap", gap, f"a number of a state, from 0 to {widest - 1}, or None")
        sizes = torch.bincount(units.site_of().cpu(), minlength=n_sites)
        counts = ~((at.cpu() % widest == gap) & (sizes[units.site_of().cpu()] > 1))
    site = torch.zeros(units.n, n_sites, dtype=torch.float64, device="cpu")
    site[torch.arange(units.n, device="cpu"), units.site_of().cpu()] = counts.double()
    site = site.to(found.J.device)
    norms = (site.T @ found.J.square() @ site).sqrt()
    norms = (norms + norms.mT) / 2  # the same to the last digit
    norms.diagonal(dim1=-2, dim2=-1).zero_()
    if not corrected or n_sites < 2:
        return norms
    of_sites = norms.sum(-1) / (n_sites - 1)
    mean = of_sites.mean(-1)[..., None, None]
    product = of_sites.unsqueeze(-1) * of_sites.unsqueeze(-2)
    scores = norms - torch.where(mean > 0, product / mean, 0.0)
    scores.diagonal(dim1=-2, dim2=-1).zero_()
    return scores


def _places(units: Units) -> tuple[Tensor, int, int]:
    """Place of each entry in a table of sites and states, ``(n,)``, and the sizes of the table."""
    site_of = units.site_of()
    sizes = torch.bincount(site_of, minlength=units.n_sites)
    begin = sizes.cumsum(0) - sizes
    widest = int(sizes.max())
    place = site_of * widest + torch.arange(units.n, device=site_of.device) - begin[site_of]
    return place, units.n_sites, widest


def _values(units: Units, like: Tensor) -> tuple[Tensor, Tensor]:
    """The low value of each entry and what it gains; -1 and 2 where entries are taken as they are."""
    form = units.bits()
    low, width = like.new_full((units.n,), -1.0), like.new_full((units.n,), 2.0)
    alone = form.lone()
    at = form.at[alone].to(like.device)
    low[at], width[at] = (part[alone].to(like) for part in (form.low, form.width))
    return low, width


def _effective(model: RBM, weight: Tensor, c: Tensor, b: Tensor) -> Couplings:
    """Effective couplings, from weights and biases in spins and the zero-sum gauge."""
    units, site_of = model.visible, model.visible.site_of()
    at, n_sites, widest = _places(units)
    is_state = torch.zeros(units.n, dtype=torch.bool, device=weight.device)
    form = units.bits()
    is_state[[int(form.at[bit]) for group in form.groups for bit in group]] = True
    # What a site adds to the hidden fields in each of its states: a column of W, or plus and minus one.
    n_states = widest if bool(is_state.all()) else max(widest, 2)
    table, slot = (n_sites, n_states), (at // widest) * n_states + at % widest
    other = slot[~is_state] + 1
    added = weight.new_zeros(*weight.shape[:-1], n_sites * n_states)
    exists = weight.new_zeros(n_sites * n_states)
    added[..., slot], added[..., other] = weight, -weight[..., ~is_state]
    exists[slot], exists[other] = 1.0, 1.0
    added, exists = added.unflatten(-1, table), exists.unflatten(0, table)
    share = exists / exists.sum(-1, keepdim=True)
    spread = (added.square() * share).sum(-1)  # variance of the field of each site, (*replicas, n_hidden, n_sites)
    of_pairs = weight.new_zeros(*model.replicas, *table, *table)
    of_sites = weight.new_zeros(*model.replicas, *table)
    nodes, rule = _rule(weight)
    # Of two values everywhere, a series gives what most hidden units contribute; pair by pair is for the others.
    in_spins = model.replicas == () and n_states == 2 and not bool(is_state.any())
    of_spins, slow = couplings_by_series(model.hidden, weight, c) if in_spins else (None, None)
    hidden = model.hidden if slow is None or not len(slow) else model.hidden.select(slow)
    part = slice(None) if slow is None else slow
    own_c, own_added, own_spread = c[..., part], added[..., part, :, :], spread[..., part, :]
    rows = max(1, NUMBERS // (max(1, own_c.numel()) * n_states**2))
    for site in range(n_sites):
        rest = (spread.sum(-1) - spread[..., site])[..., None, None].clamp_min(0.0)
        field = c[..., None, None] + added[..., site, None, :]
        of_sites[..., site : site + 1, :] = _expected(model.hidden, c.ndim - 1, field, rest, nodes, rule)
        if not own_c.numel():
            continue
        rest = (own_spread.sum(-1) - own_spread[..., site])[..., None, None].clamp_min(0.0)
        field = own_c[..., None, None] + own_added[..., site, None, :]
        # Pairs with the sites before are known: they are the same the other way round.
        for some in torch.arange(site + 1, n_sites, device=weight.device).split(rows):
            left = (rest - own_spread[..., None, some]).clamp_min(0.0)
            both = field.mT.unsqueeze(-1) + own_added[..., None, some, :]
            found = _expected(hidden, c.ndim - 1, both, left.unsqueeze(-1), nodes, rule)
            of_pairs[..., site, :, some, :] = found
            of_pairs[..., some, :, site, :] = found.movedim(-3, -1)
    of_pairs = of_pairs - (of_pairs * share).sum(-1, keepdim=True)
    of_pairs = of_pairs - (of_pairs * share[..., None, None]).sum(-3, keepdim=True)
    of_sites = of_sites - (of_sites * share).sum(-1, keepdim=True)
    coupling = of_pairs.flatten(-4, -3).flatten(-2, -1)[..., slot.unsqueeze(-1), slot]
    coupling = coupling if of_spins is None else coupling + of_spins
    coupling = ((coupling + coupling.mT) / 2).masked_fill(site_of.unsqueeze(-1) == site_of, 0.0)
    return Couplings(coupling, b + of_sites.flatten(-2)[..., slot], units)


def _expected(hidden: Units, n_axes: int, field: Tensor, variance: Tensor, nodes: Tensor, rule: Tensor) -> Tensor:
    """Sum over the hidden units of the mean cumulant of normal fields; the hidden axis goes away."""
    deviation = variance.sqrt()
    total = field.new_zeros(())
    for node, share in zip(nodes, rule, strict=True):
        moved = (field + deviation * node).flatten(n_axes + 1).mT
        cumulant = hidden.cumulant(moved).sum(-1).unflatten(-1, field.shape[n_axes + 1 :])
        total = total + share * cumulant
    return total


def _rule(like: Tensor) -> tuple[Tensor, Tensor]:
    """Nodes and weights of a normal mean."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(N_NODES)
    return torch.as_tensor(nodes, device="cpu").to(like), torch.as_tensor(
        weights / math.sqrt(2 * math.pi), device="cpu"
    ).to(like)
