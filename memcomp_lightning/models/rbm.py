"""The restricted Boltzmann machine, of units of any kind."""

from collections.abc import Sequence

import torch
from torch import Generator, Tensor, nn
from torch.linalg import vecdot

from memcomp_lightning.errors import require
from memcomp_lightning.models.affine import affine, plus_product, scaled
from memcomp_lightning.models.base import Block, Hidden, PerState, QuadraticForm, TwoLayers, Visible
from memcomp_lightning.models.chains import TwoLayerChains
from memcomp_lightning.models.init import Initialiser, initial
from memcomp_lightning.models.machine import Machine, joined, log2_states, units_of
from memcomp_lightning.models.units import Units, all_states
from memcomp_lightning.types import Configurations, Weighted


class RBM(Machine):
    r"""A model of data: visible units hold it, hidden units explain it, couplings join the two layers only.

    .. math:: E(v, h) = -\sum_{ij} w_{ij} h_i v_j - \sum_j b_j v_j - \sum_i c_i h_i - \log \mu(v) - \log \mu(h)

    (Manukian et al. 2019, eq. 3.) The kinds of units say what v and h may be and give the measures
    :math:`\mu`, which are 1 for units in {0, 1}, spins and categories. Where they are 1, values in between stand
    for the means of independent units: the energy is then the expected one, because E is linear in each unit.

    Attributes:
        weight: ``(*replicas, n_hidden, n_visible)``; of categorical units there is a column for each state.
        b: Visible bias, ``(*replicas, n_visible)``.
        c: Hidden bias, ``(*replicas, n_hidden)``.
        visible: The kind of the visible units.
        hidden: The kind of the hidden units.

    Args:
        n_visible: Number of visible units in {0, 1}, >= 1; None where ``visible`` says it.
        n_hidden: Number of hidden units in {0, 1}, >= 1; None where ``hidden`` says it.
        visible: Kind of the visible units, see :mod:`memcomp_lightning.models.units`.
        hidden: Kind of the hidden units. Real ones ask for visible units that are not; their precision is fixed.
        replicas: Leading axes of independent machines that share every call.
        weight_init: Draws the weights; the biases start at zero.
        generator: Random stream of the weights; None is a fresh stream of seed 0.

    >>> rbm = RBM(n_visible=3, n_hidden=2)
    >>> rbm.energy(torch.zeros(5, 3), torch.zeros(5, 2)).shape
    torch.Size([5])
    >>> from memcomp_lightning.models.units import Categorical, Spin
    >>> RBM(visible=Categorical(53, q=21), hidden=Spin(10)).weight.shape
    torch.Size([10, 1113])
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        n_visible: int | None = None,
        n_hidden: int | None = None,
        *,
        visible: Units | None = None,
        hidden: Units | None = None,
        replicas: tuple[int, ...] = (),
        weight_init: Initialiser | None = None,
        generator: Generator | None = None,
    ) -> None:
        visible, hidden = units_of("visible", n_visible, visible), units_of("hidden", n_hidden, hidden)
        both = visible.real and hidden.real
        kinds = f"{type(visible).__name__} and {type(hidden).__name__}"
        allowed = "real units in one layer at most, as Z may be infinite otherwise"
        require(not both, "kinds of visible and hidden units", kinds, allowed)
        learned = hidden.curvature is not None and hidden.curvature.requires_grad
        remedy = "The weights set the scale of hidden units: take Gaussian(n, learned=False)."
        require(not learned, "precision of the hidden units", "learned", "a fixed one", remedy)
        super().__init__(visible.for_replicas(replicas), hidden.for_replicas(replicas))
        weight = initial((*replicas, hidden.n, visible.n), weight_init, generator)
        self.weight = nn.Parameter(weight)
        self.b = nn.Parameter(weight.new_zeros(*replicas, visible.n))
        self.c = nn.Parameter(weight.new_zeros(*replicas, hidden.n))

    def tempered_energy(self, v: Visible, h: Hidden) -> PerState:
        """E(v, h) without the measures (eq. 3)."""
        hidden_part = (self.hidden_field(v) * h).sum(-1)
        return -hidden_part - (v * self.b.unsqueeze(-2)).sum(-1)

    def _moments(self, parts: Sequence[Weighted]) -> tuple[Tensor, Tensor, Tensor]:
        of_weight = of_b = of_c = None
        for v, h, weight in parts:
            # A weighted copy of the hidden units alone: entries of categorical visible ones are many.
            weighted_h, each = h * weight.unsqueeze(-1), weight.unsqueeze(-2)
            of_weight = plus_product(of_weight, weighted_h.mT, v)
            of_b, of_c = plus_product(of_b, each, v), plus_product(of_c, each, h)
        assert of_weight is not None
        assert of_b is not None
        assert of_c is not None
        return of_weight, of_b.squeeze(-2), of_c.squeeze(-2)

    def _own_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        of_weight, of_b, of_c = centred
        of_b = of_b - (hidden_offset.unsqueeze(-2) @ of_weight).squeeze(-2)
        of_c = of_c - (of_weight @ visible_offset.unsqueeze(-1)).squeeze(-1)
        return of_weight, of_b, of_c

    def _by_parameter(self, moments: Sequence[Tensor]) -> list[tuple[nn.Parameter, Tensor]]:
        return list(zip((self.weight, self.b, self.c), moments, strict=True))

    def _plain_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        of_weight, of_b, of_c = centred
        of_b = of_b + (hidden_offset.unsqueeze(-2) @ of_weight).squeeze(-2)
        of_c = of_c + (of_weight @ visible_offset.unsqueeze(-1)).squeeze(-1)
        left = torch.stack((hidden_offset, of_c), dim=-1)
        return of_weight + left @ torch.stack((of_b, visible_offset), dim=-2), of_b, of_c

    def _energy_of(self, moments: Sequence[Tensor]) -> Tensor:
        of_weight, of_b, of_c = moments
        coupled: Tensor = vecdot(self.weight.flatten(-2), of_weight.flatten(-2))
        biases: Tensor = vecdot(self.b, of_b) + vecdot(self.c, of_c)
        return -(coupled + biases)

    def free_energy(self, v: Visible) -> PerState:
        r"""F(v) = -b.v - log mu(v) - \sum_i A(W v + c)_i with the cumulant A, so that p(v) = exp(-F(v)) / Z."""
        free = -self.hidden.cumulant(self.hidden_field(v)).sum(-1) - (v * self.b.unsqueeze(-2)).sum(-1)
        return free if self.visible.linear else free + self.visible.energy(v)

    def hidden_free_energy(self, h: Hidden) -> PerState:
        r"""F(h) = -c.h - log mu(h) - \sum_j A(W^T h + b)_j, so that p(h) = exp(-F(h)) / Z."""
        free = -self.visible.cumulant(self.visible_field(h)).sum(-1) - (h * self.c.unsqueeze(-2)).sum(-1)
        return free if self.hidden.linear else free + self.hidden.energy(h)

    def hidden_field(self, v: Visible) -> Hidden:
        """W v + c, the fields of the hidden units: the log odds of units in {0, 1}."""
        return affine(v, self.weight, self.c)

    def visible_field(self, h: Hidden) -> Visible:
        """W^T h + b, the fields of the visible units."""
        return affine(h, self.weight.mT, self.b)

    def hidden_mean(self, v: Visible, *, beta: float | Tensor = 1.0) -> Hidden:
        """E[h | v] at inverse temperature ``beta`` (eq. 7), a number or ``(*replicas, n, 1)``."""
        return self.hidden.mean(scaled(self.hidden_field(v), beta))

    def visible_mean(self, h: Hidden, *, beta: float | Tensor = 1.0) -> Visible:
        """E[v | h] at inverse temperature ``beta`` (eq. 8), a number or ``(*replicas, n, 1)``."""
        return self.visible.mean(scaled(self.visible_field(h), beta))

    def draw_hidden(self, v: Visible, *, beta: float | Tensor = 1.0, generator: Generator) -> Hidden:
        """Draw h given v, at inverse temperature ``beta``."""
        return self.hidden.sample(scaled(self.hidden_field(v), beta), generator=generator)

    def draw_visible(self, h: Hidden, *, beta: float | Tensor = 1.0, generator: Generator) -> Visible:
        """Draw v given h, at inverse temperature ``beta``."""
        return self.visible.sample(scaled(self.visible_field(h), beta), generator=generator)

    @property
    def classes(self) -> list[Tensor]:
        """Indices of the visible and of the hidden units."""
        units = torch.arange(self.n_units, device=self.b.device)
        return [units[: self.n_visible], units[self.n_visible :]]

    def blocks(self) -> list[Block]:
        """The visible and the hidden units, with their couplings."""
        first, second = self.classes
        return [
            Block(first, second, self.weight.mT, self.b, self.visible),
            Block(second, first, self.weight, self.c, self.hidden),
        ]

    def chains(self) -> TwoLayerChains:
        """Gibbs chains of the visible units, at the present parameters."""
        return TwoLayerChains(self)

    @property
    def enumerates_hidden(self) -> bool:
        """Whether exact computations enumerate the hidden layer: it has fewer states, or the other is real."""
        if self.visible.real or self.hidden.real:
            return self.visible.real
        return self.hidden.n_states < self.visible.n_states

    @property
    def n_enumerated(self) -> float:
        """Number of bits that exact computations enumerate: log2 of the states of the smaller layer."""
        return log2_states(self.hidden if self.enumerates_hidden else self.visible)

    def outside_largest_class(self) -> tuple[Block, Tensor, Units]:
        """The larger layer, the units of the smaller one, and what these are."""
        visible, hidden = self.blocks()
        return (
            (visible, hidden.units, self.hidden)
            if self.enumerates_hidden
            else (hidden, visible.units, self.visible)
        )

    @torch.no_grad()
    def all_configurations(self) -> Configurations:
        """All states of the smaller layer with their probabilities as weights, the other layer by its means.

        Of real units there are points that have these means and the right variances.
        """
        layer = self.hidden if self.enumerates_hidden else self.visible
        states = all_states(layer, self.b)
        states = states.expand(*self.replicas, *states.shape)
        free_energy = self.hidden_free_energy(states) if self.enumerates_hidden else self.free_energy(states)
        weight = torch.softmax(-free_energy.double(), dim=-1).to(states.dtype)
        if self.enumerates_hidden:
            found = [Configurations(v, states, weight) for v in self.visible.points(self.visible_field(states))]
        else:
            found = [Configurations(states, h, weight) for h in self.hidden.points(self.hidden_field(states))]
        return joined(found)

    def quadratic_form(self) -> QuadraticForm:
        """The weights as couplings of all hidden to all visible units, and both biases."""
        return QuadraticForm(None, self.weight, torch.cat((self.b, self.c), dim=-1))

    def two_layers(self) -> TwoLayers:
        """Itself."""
        return TwoLayers(self, None)

    def forward(self, v: Visible) -> Hidden:
        """The layer as part of a feed-forward network: E[h | v]."""
        return self.hidden_mean(v)
