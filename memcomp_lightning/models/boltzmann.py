"""The Boltzmann machine: visible and hidden units with any symmetric connectivity."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn
from torch.linalg import vecdot

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.affine import affine, plus_product
from memcomp_lightning.models.base import Block, Hidden, PerState, QuadraticForm, TwoLayers, Visible
from memcomp_lightning.models.chains import ClassChains
from memcomp_lightning.models.connectivity import Pairs, pairs_of
from memcomp_lightning.models.init import Initialiser, Normal
from memcomp_lightning.models.layouts import INDICES, Layout, classes_of, layouts_of, of_entries
from memcomp_lightning.models.machine import Machine, joined, log2_states, units_of
from memcomp_lightning.models.mean_field import free_energy_of_means, mean_field
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.units import Bernoulli, Mixed, Units, all_states, side_by_side
from memcomp_lightning.rng import stream
from memcomp_lightning.types import Configurations, Weighted

_DENSE = 0.5
"""Share of all pairs of units from which on couplings stand in one matrix, not in one for each class."""


class BoltzmannMachine(Machine):
    r"""A model of data v with hidden units h: x = (v, h), with couplings between any pairs.

    .. math:: E(x) = -\sum_{(i, j)} w_{ij} x_i x_j - \sum_i a_i x_i - \log \mu(x), \qquad a = (b, c)

    (Ackley, Hinton & Sejnowski 1985.) The units are split into classes without couplings inside, so that a class
    is drawn, or its means are taken, at once. Values between those of the units stand for the means of independent
    ones. With spins and no hidden units it is an Ising model with the couplings J and the biases h; with
    categorical units a Potts model, whose pairs of sites have a coupling for each pair of states.

    Attributes:
        pairs: Coupled entries, ``(n_pairs, 2)``, visible ones numbered first; part of the state dict, so that
            weights go into a machine of the same pairs alone.
        coupling: w, one number a pair, ``(*replicas, n_pairs)``.
        b: Visible bias, ``(*replicas, n_visible)``.
        c: Hidden bias, ``(*replicas, n_hidden)``.
        classes: Indices of the units of each class; classes with more visible units come first.

    Args:
        n_visible: Number of visible units in {0, 1}, >= 1; None where ``visible`` says it.
        n_hidden: Number of hidden units in {0, 1}, >= 0; None where ``hidden`` says it, or else what the pairs of
            ``connectivity`` have beside the visible ones.
        connectivity: Pairs of sites (for units of one entry, of units), or a symmetric mask
            ``(n_sites, n_sites)``; None couples all. See :mod:`memcomp_lightning.models.connectivity` for grids,
            layers and graphs of annealers.
        visible: Kind of the visible units, see :mod:`memcomp_lightning.models.units`.
        hidden: Kind of the hidden units, not real.
        replicas: Leading axes of independent machines that share every call.
        weight_init: Draws a matrix ``(*replicas, n_units, n_units)``, whose upper triangle gives the couplings;
            the biases start at zero.
        generator: Random stream of the couplings; None is a fresh stream of seed 0.

    Raises:
        SettingError: A mask that is not symmetric or couples a unit to itself; a pair that is given twice or whose
            units do not exist; a visible unit without any coupling; two real units that are coupled.

    >>> machine = BoltzmannMachine(n_visible=3, n_hidden=2)
    >>> machine.energy(torch.zeros(5, 3), torch.zeros(5, 2)).shape
    torch.Size([5])
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        n_visible: int | None = None,
        n_hidden: int | None = None,
        connectivity: Tensor | Iterable[tuple[int, int]] | None = None,
        *,
        visible: Units | None = None,
        hidden: Units | None = None,
        replicas: tuple[int, ...] = (),
        weight_init: Initialiser | None = None,
        generator: Generator | None = None,
    ) -> None:
        visible = units_of("visible", n_visible, visible)
        if n_hidden is None and hidden is None:
            listed = isinstance(connectivity, Tensor) and connectivity.ndim == 2 and connectivity.shape[1] == 2
            require(listed, "n_hidden", n_hidden, "a number, unless connectivity is a tensor of pairs")
            assert isinstance(connectivity, Tensor)
            n_hidden = int(connectivity.max()) + 1 - visible.n_sites
        if hidden is None:
            require_count("n_hidden", n_hidden, minimum=0)
            assert n_hidden is not None
            hidden = Bernoulli(n_hidden)
        require(not hidden.real, "kind of the hidden units", type(hidden).__name__, "units that are not real")
        super().__init__(visible.for_replicas(replicas), hidden.for_replicas(replicas))
        n_visible, n_units = visible.n, visible.n + hidden.n
        site_of = torch.cat((visible.site_of(), hidden.site_of() + visible.n_sites))
        n_sites = visible.n_sites + hidden.n_sites
        site_pairs = pairs_of(n_sites, connectivity)
        pairs = of_entries(site_pairs, site_of, n_sites)
        _refuse_real_pairs(visible, pairs)
        alone = torch.bincount(site_pairs.flatten(), minlength=n_sites)[: visible.n_sites] == 0
        require(
            not bool(alone.any()) or n_sites == 1,
            "visible unit",
            alone.nonzero()[:5].flatten().tolist(),
            "at least one coupling for each visible unit",
            "A unit without couplings learns its mean alone: couple it, or leave it out of the data.",
        )
        generator = stream(0, "weights") if generator is None else generator
        self.pairs: Tensor
        self.register_buffer("pairs", pairs)
        draw = self._initial(n_units, replicas, weight_init or Normal(std=0.01), generator)
        self.coupling = nn.Parameter(draw)
        self.b = nn.Parameter(draw.new_zeros(*replicas, n_visible))
        self.c = nn.Parameter(draw.new_zeros(*replicas, hidden.n))
        classes_of_sites = classes_of(n_sites, site_pairs, site_of[:n_visible][_is_real(visible)].unique())
        coloured = [torch.isin(site_of, sites).nonzero().flatten() for sites in classes_of_sites]
        classes = sorted(coloured, key=lambda units: -int((units < n_visible).sum()))
        kinds = [_kind_of(self.visible, self.hidden, units) for units in classes]
        # Without parameters of their own they stay as they are, and are not made anew at each sweep.
        changing = any(buffer.is_floating_point() for kind in kinds for buffer in kind.buffers())
        self._kinds = None if changing else nn.ModuleList(kinds)
        # Of two classes the blocks are halves of such a matrix already.
        self._dense = len(classes) > 2 and 2 * len(pairs) >= _DENSE * n_units * (n_units - 1)
        self._n_forward: list[int] = []
        for number, layout in enumerate(layouts_of(n_units, pairs, classes)):
            self._n_forward.append(layout.n_forward)
            for name in INDICES:
                self.register_buffer(f"_{name}{number}", getattr(layout, name), persistent=False)

    def other_pairs(self, pairs: Tensor | None) -> str:
        """Say what speaks against couplings of the pairs of a weight file in this machine; empty if nothing does.

        A file that has none, as those of version 0.1, is taken to be of all pairs, and refused in other machines.
        """
        if pairs is None:
            known = len(self.pairs) == self.n_units * (self.n_units - 1) // 2
            return "" if known else "the couplings are of unknown pairs, because the file does not hold them."
        if self.pairs.equal(pairs.to(self.pairs)):
            return ""
        own, given = ({tuple(pair) for pair in some.tolist()} for some in (self.pairs, pairs))
        only = min(given ^ own, default=())
        where = "the file" if only in given else "this machine"
        return f"the couplings are of other pairs of units: {only} is coupled in {where} alone."

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *arguments: Any) -> None:
        """Refuse couplings of other pairs."""
        name = f"{prefix}pairs"
        *_, error_messages = arguments
        if reason := self.other_pairs(state_dict.get(name)):
            error_messages.append(reason)
        state_dict[name] = self.pairs
        super()._load_from_state_dict(state_dict, prefix, *arguments)

    def _initial(
        self, n_units: int, replicas: tuple[int, ...], weight_init: Initialiser, generator: Generator
    ) -> Tensor:
        """Initial couplings."""
        matrix = weight_init((*replicas, n_units, n_units), generator=generator)
        return matrix[..., self.pairs[:, 0], self.pairs[:, 1]]

    @property
    def bias(self) -> Tensor:
        """Biases of all units, a = (b, c), ``(*replicas, n_units)``."""
        return torch.cat((self.b, self.c), dim=-1)

    @property
    def classes(self) -> list[Tensor]:
        """Indices of the units of each colour."""
        return [layout.units for layout in self._layouts()]

    def _layouts(self) -> list[Layout]:
        buffers: dict[str, Any] = self._buffers  # many of them are asked for at each sweep
        return [
            Layout._make([*(buffers[f"_{name}{number}"] for name in INDICES), n_forward])
            for number, n_forward in enumerate(self._n_forward)
        ]

    def blocks(self) -> list[Block]:
        """The classes, each with its couplings: what a sweep over all units needs."""
        layouts = self._layouts()
        kinds: Iterable[Any] = self._kinds or [
            _kind_of(self.visible, self.hidden, layout.units) for layout in layouts
        ]
        sizes = [layout.units.shape[0] for layout in layouts]
        order = torch.cat([layout.units for layout in layouts])
        biases = self.bias.index_select(-1, order).split(sizes, dim=-1)
        couplings: Iterable[Tensor] = (
            self._matrix().index_select(-2, order).split(sizes, dim=-2)
            if self._dense
            else self._weights_of(layouts)
        )
        parts = zip(layouts, couplings, biases, kinds, strict=True)
        return [Block(layout.units, layout.neighbours, weight, bias, kind) for layout, weight, bias, kind in parts]

    def _weights_of(self, layouts: Sequence[Layout]) -> list[Tensor]:
        """Couplings of the units of each class to their neighbours, ``(*replicas, n_class, n_neighbours)``."""
        return [
            self._placed((len(units), len(neighbours)), slot, self.coupling.index_select(-1, edge))
            for units, neighbours, edge, slot, _ in layouts
        ]

    def _matrix(self) -> Tensor:
        """The couplings of all units to all units, ``(*replicas, n_units, n_units)``."""
        upper = self._upper()
        return upper + upper.mT

    def _upper(self) -> Tensor:
        """The same with each pair once."""
        first, second = self.pairs.unbind(-1)
        return self._placed((self.n_units, self.n_units), first * self.n_units + second, self.coupling)

    def _placed(self, shape: tuple[int, int], at: Tensor, coupling: Tensor) -> Tensor:
        """Couplings at these places of a flat matrix of zeros, as a matrix."""
        flat = self.coupling.new_zeros(*self.replicas, math.prod(shape))
        placed: Tensor = flat.index_copy(-1, at, coupling).unflatten(-1, shape)
        return placed

    def chains(self) -> ClassChains:
        """Gibbs chains of all units, at the present parameters."""
        return ClassChains(self)

    @property
    def n_enumerated(self) -> float:
        """Number of bits that exact computations enumerate: those of all units outside the largest class."""
        return log2_states(self.outside_largest_class()[2])

    def outside_largest_class(self) -> tuple[Block, Tensor, Units]:
        """The class whose states are summed in closed form, all other units, and what these are."""
        largest = max(self.blocks(), key=lambda block: math.inf if block.kind.real else log2_states(block.kind))
        others = torch.ones(self.n_units, dtype=torch.bool, device=self.b.device)
        others[largest.units] = False
        entries = others.nonzero().flatten()
        return largest, entries, _kind_of(self.visible, self.hidden, entries)

    @torch.no_grad()
    def all_configurations(self) -> Configurations:
        """All states outside the largest class with their probabilities as weights, that class by its means."""
        largest, others, kind = self.outside_largest_class()
        states = all_states(kind, self.b)
        x = states.new_zeros(*self.replicas, len(states), self.n_units)
        x[..., others] = states
        # Summed over the largest class: exp(-E) with that class at zero, times exp(A(field)) a site.
        field, n = largest.field(x), self.n_visible
        log_weight = largest.kind.cumulant(field.double()).sum(-1) - self.energy(x[..., :n], x[..., n:]).double()
        weight, found = torch.softmax(log_weight, dim=-1).to(x.dtype), []
        for values in largest.kind.points(field):
            x = x.clone()
            x[..., largest.units] = values
            found.append(Configurations(x[..., :n], x[..., n:], weight))
        return joined(found)

    def quadratic_form(self) -> QuadraticForm:
        """The couplings of all pairs, and the biases."""
        return QuadraticForm(self.pairs, self.coupling, self.bias)

    def two_layers(self) -> TwoLayers | None:
        """The RBM between the two classes of units, where there are two.

        Of a DBM it has the odd layers on one side and the even ones on the other (Salakhutdinov & Hinton 2009).
        """
        return TwoLayers(_folded(self), torch.cat(self.classes)) if len(self.classes) == 2 else None

    @property
    def weight(self) -> Float[Tensor, "*replicas n_hidden n_visible"]:
        """Couplings of hidden to visible units, zero where there are none, as a copy."""
        n, (first, second) = self.n_visible, self.pairs.unbind(-1)
        across = (first < n) & (second >= n)
        at = (second[across] - n) * n + first[across]
        return self._placed((self.n_hidden, n), at, self.coupling[..., across])

    def tempered_energy(self, v: Visible, h: Hidden) -> PerState:
        """E(v, h) without the measures of the units."""
        x = torch.cat((v, h), dim=-1)
        if self._dense:
            return -(affine(x, self._upper(), self.bias) * x).sum(-1)
        coupled = sum(
            ((block.field(x) - block.bias.unsqueeze(-2)) * x[..., block.units]).sum(-1) for block in self.blocks()
        )
        return -0.5 * coupled - (x * self.bias.unsqueeze(-2)).sum(-1)

    def _own_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> tuple[Tensor, Tensor]:
        of_pairs, of_units = centred
        offset = torch.cat((visible_offset, hidden_offset), dim=-1)
        first, second = self.pairs[:, 0], self.pairs[:, 1]
        of_units = of_units.index_add(-1, first, of_pairs * offset[..., second], alpha=-1)
        return of_pairs, of_units.index_add(-1, second, of_pairs * offset[..., first], alpha=-1)

    def _plain_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> tuple[Tensor, Tensor]:
        of_pairs, of_units = centred
        offset = torch.cat((visible_offset, hidden_offset), dim=-1)
        first, second = self.pairs[:, 0], self.pairs[:, 1]
        of_units = of_units.index_add(-1, first, of_pairs * offset[..., second])
        of_units = of_units.index_add(-1, second, of_pairs * offset[..., first])
        across = offset[..., first] * of_units[..., second] + offset[..., second] * of_units[..., first]
        return of_pairs + across, of_units

    def _moments(self, parts: Sequence[Weighted]) -> tuple[Tensor, Tensor]:
        joint = [torch.cat((v, h), dim=-1) for v, h, _ in parts]
        weighted = [x * weight.unsqueeze(-1) for x, (_, _, weight) in zip(joint, parts, strict=True)]
        of_units = sum(some.sum(-2) for some in weighted)
        assert isinstance(of_units, Tensor)
        if self._dense:
            at = self.pairs[:, 0] * self.n_units + self.pairs[:, 1]
            return self._products(joint, weighted, slice(None), slice(None))[..., at], of_units
        of_pairs = torch.empty_like(self.coupling)
        for units, neighbours, edge, slot, n in self._layouts():
            if n:
                products = self._products(joint, weighted, units, neighbours)
                of_pairs.index_copy_(-1, edge[:n], products[..., slot[:n]])
        return of_pairs, of_units

    def _products(
        self, joint: Sequence[Tensor], weighted: Sequence[Tensor], rows: Tensor | slice, columns: Tensor | slice
    ) -> Tensor:
        """Sums over configurations of the product of each two units, as a flat matrix."""
        total = None
        for x, y in zip(joint, weighted, strict=True):
            total = plus_product(total, x[..., rows].mT, y[..., columns])
        assert total is not None
        return total.flatten(-2)

    def _by_parameter(self, moments: Sequence[Tensor]) -> list[tuple[nn.Parameter, Tensor]]:
        of_pairs, of_units = moments
        of_b, of_c = of_units.split([self.n_visible, self.n_hidden], dim=-1)
        return [(self.coupling, of_pairs), (self.b, of_b.contiguous()), (self.c, of_c.contiguous())]

    def _energy_of(self, moments: Sequence[Tensor]) -> Tensor:
        of_pairs, of_units = moments
        total: Tensor = -(vecdot(self.coupling, of_pairs) + vecdot(self.bias, of_units))
        return total

    def hidden_mean(self, v: Visible) -> Hidden:
        """E[h | v]: exact if no two hidden units are coupled, otherwise by :func:`mean_field`, its defaults."""
        return mean_field(self, v).h

    def visible_mean(self, h: Hidden) -> Visible:
        """E[v | h]: exact if no two visible units are coupled, otherwise by the mean field."""
        return mean_field(self, h, clamped="hidden").h

    def free_energy(self, v: Visible) -> PerState:
        r"""The mean-field free energy, ``E(v, m) - \sum_i H(m_i)`` with the means m of the hidden units.

        It is F(v) if no two hidden units are coupled, and above it otherwise.
        """
        return free_energy_of_means(self, v, self.hidden_mean(v))


@torch.no_grad()
def _folded(model: BoltzmannMachine) -> RBM:
    """The RBM between the two classes of a machine that has two, the units of the first as its visible ones."""
    first, second = model.blocks()
    rbm = RBM(visible=first.kind, hidden=second.kind, replicas=model.replicas)
    rbm.to(model.b)
    weight = torch.zeros_like(rbm.weight)
    weight[..., torch.searchsorted(first.units, second.neighbours)] = second.weight
    rbm.weight.copy_(weight)
    rbm.b.copy_(first.bias)
    rbm.c.copy_(second.bias)
    return rbm


def _kind_of(visible: Units, hidden: Units, entries: Tensor) -> Units:
    """What some entries of a machine are."""
    if len(entries) == 0 or (isinstance(visible, Bernoulli) and isinstance(hidden, Bernoulli)):
        return Bernoulli(len(entries))
    seen = entries < visible.n
    return side_by_side(visible.select(entries[seen]), hidden.select(entries[~seen] - visible.n))


def _is_real(units: Units) -> Tensor:
    """Which entries are real, ``(n,)``."""
    if isinstance(units, Mixed):
        return torch.cat([_is_real(kind) for kind in units.kinds])
    return torch.full((units.n,), units.real, dtype=torch.bool, device="cpu")


def _refuse_real_pairs(visible: Units, pairs: Pairs) -> None:
    """Raise if two real units are coupled: the energy need not be bounded then."""
    n, real = visible.n, _is_real(visible)
    among = pairs[(pairs < n).all(-1)]
    coupled = among[real[among].all(-1)]
    allowed = "no couplings between real units, as in an RBM"
    require(not len(coupled), "coupled real units", coupled[:1].flatten().tolist(), allowed)
