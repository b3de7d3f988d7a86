"""The Bernoulli restricted Boltzmann machine."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn
from torch.linalg import vecdot

from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import require_count
from memcomp_lightning.models.affine import affine
from memcomp_lightning.models.base import Block, Hidden, PerState, QuadraticForm, TwoLayers, Visible
from memcomp_lightning.models.chains import TwoLayerChains
from memcomp_lightning.models.init import Initialiser, initial
from memcomp_lightning.models.machine import Machine
from memcomp_lightning.types import Configurations


class RBM(Machine):
    r"""A model of binary data: visible units hold it, hidden units explain it, couplings join the two layers only.

    .. math:: E(v, h) = -\sum_{ij} w_{ij} h_i v_j - \sum_j b_j v_j - \sum_i c_i h_i

    (Manukian et al. 2019, eq. 3.) Real values in [0, 1] stand for the probabilities of independent units:
    the energy is then the expected one, because E is linear in each unit.

    Attributes:
        weight: ``(*replicas, n_hidden, n_visible)``.
        b: Visible bias, ``(*replicas, n_visible)``.
        c: Hidden bias, ``(*replicas, n_hidden)``.

    Args:
        n_visible: Number of visible units, >= 1.
        n_hidden: Number of hidden units, >= 1.
        replicas: Leading axes of independent machines that share every call.
        weight_init: Draws the weights; the biases start at zero.
        generator: Random stream of the weights; None is a fresh stream of seed 0.

    >>> rbm = RBM(n_visible=3, n_hidden=2)
    >>> rbm.energy(torch.zeros(5, 3), torch.zeros(5, 2)).shape
    torch.Size([5])
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        n_visible: int,
        n_hidden: int,
        *,
        replicas: tuple[int, ...] = (),
        weight_init: Initialiser | None = None,
        generator: Generator | None = None,
    ) -> None:
        super().__init__()
        require_count("n_visible", n_visible)
        require_count("n_hidden", n_hidden)
        weight = initial((*replicas, n_hidden, n_visible), weight_init, generator)
        self.weight = nn.Parameter(weight)
        self.b = nn.Parameter(weight.new_zeros(*replicas, n_visible))
        self.c = nn.Parameter(weight.new_zeros(*replicas, n_hidden))

    def energy(self, v: Visible, h: Hidden) -> PerState:
        """E(v, h) of each configuration (eq. 3)."""
        hidden_part = (self.hidden_field(v) * h).sum(-1)
        return -hidden_part - (v * self.b.unsqueeze(-2)).sum(-1)

    def _moments(self, v: Tensor, h: Tensor, weight: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        weighted_v = v * weight.unsqueeze(-1)
        return h.mT @ weighted_v, weighted_v.sum(-2), (h * weight.unsqueeze(-1)).sum(-2)

    def _centred_moments(
        self, v: Tensor, h: Tensor, weight: Tensor, visible_offset: Tensor, hidden_offset: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        centred_v = v - visible_offset.unsqueeze(-2)
        weighted_h = (h - hidden_offset.unsqueeze(-2)) * weight.unsqueeze(-1)
        of_weight = weighted_h.mT @ centred_v
        of_b = (centred_v * weight.unsqueeze(-1)).sum(-2) - (hidden_offset.unsqueeze(-2) @ of_weight).squeeze(-2)
        of_c = weighted_h.sum(-2) - (of_weight @ visible_offset.unsqueeze(-1)).squeeze(-1)
        return of_weight, of_b, of_c

    def _energy_of(self, moments: Sequence[Tensor]) -> Tensor:
        of_weight, of_b, of_c = moments
        coupled: Tensor = vecdot(self.weight.flatten(-2), of_weight.flatten(-2))
        biases: Tensor = vecdot(self.b, of_b) + vecdot(self.c, of_c)
        return -(coupled + biases)

    def free_energy(self, v: Visible) -> PerState:
        r"""F(v) = -b.v - \sum_i softplus(W v + c)_i, so that p(v) = exp(-F(v)) / Z."""
        return -F.softplus(self.hidden_field(v)).sum(-1) - (v * self.b.unsqueeze(-2)).sum(-1)

    def hidden_free_energy(self, h: Hidden) -> PerState:
        r"""F(h) = -c.h - \sum_j softplus(W^T h + b)_j, so that p(h) = exp(-F(h)) / Z."""
        return -F.softplus(self.visible_field(h)).sum(-1) - (h * self.c.unsqueeze(-2)).sum(-1)

    def hidden_field(self, v: Visible) -> Hidden:
        """W v + c, the log odds of each hidden unit."""
        return affine(v, self.weight, self.c)

    def visible_field(self, h: Hidden) -> Visible:
        """W^T h + b, the log odds of each visible unit."""
        return affine(h, self.weight.mT, self.b)

    def hidden_mean(self, v: Visible, *, beta: float | Tensor = 1.0) -> Hidden:
        """p(h = 1 | v) at inverse temperature ``beta`` (eq. 7), a number or ``(*replicas, n, 1)``."""
        return torch.sigmoid(_scaled(self.hidden_field(v), beta))

    def visible_mean(self, h: Hidden, *, beta: float | Tensor = 1.0) -> Visible:
        """p(v = 1 | h) at inverse temperature ``beta`` (eq. 8), a number or ``(*replicas, n, 1)``."""
        return torch.sigmoid(_scaled(self.visible_field(h), beta))

    @property
    def classes(self) -> list[Tensor]:
        """Indices of the visible and of the hidden units."""
        units = torch.arange(self.n_units, device=self.b.device)
        return [units[: self.n_visible], units[self.n_visible :]]

    def blocks(self) -> list[Block]:
        """The visible and the hidden units, with their couplings."""
        first, second = self.classes
        return [Block(first, second, self.weight.mT, self.b), Block(second, first, self.weight, self.c)]

    def chains(self) -> TwoLayerChains:
        """Gibbs chains of the visible units, at the present parameters."""
        return TwoLayerChains(self)

    @property
    def n_enumerated(self) -> int:
        """Number of units whose states exact computations enumerate: those of the smaller layer."""
        return min(self.n_visible, self.n_hidden)

    @torch.no_grad()
    def all_configurations(self) -> Configurations:
        """All states of the smaller layer with their probabilities as weights, the other layer by its means."""
        hidden_first = self.n_hidden < self.n_visible
        states = binary_states(self.n_enumerated, like=self.b)
        states = states.expand(*self.replicas, *states.shape)
        free_energy = self.hidden_free_energy(states) if hidden_first else self.free_energy(states)
        weight = torch.softmax(-free_energy.double(), dim=-1).to(states.dtype)
        if hidden_first:
            return Configurations(self.visible_mean(states), states, weight)
        return Configurations(states, self.hidden_mean(states), weight)

    def quadratic_form(self) -> QuadraticForm:
        """The weights as couplings of all hidden to all visible units, and both biases."""
        return QuadraticForm(None, self.weight, torch.cat((self.b, self.c), dim=-1))

    def two_layers(self) -> TwoLayers:
        """Itself."""
        return TwoLayers(self, None)

    def forward(self, v: Visible) -> Hidden:
        """The layer as part of a feed-forward network: p(h = 1 | v)."""
        return self.hidden_mean(v)


def _scaled(field: Tensor, beta: float | Tensor) -> Tensor:
    """Field times beta, without a pass over memory in the usual case."""
    return field if isinstance(beta, float) and beta == 1.0 else beta * field
