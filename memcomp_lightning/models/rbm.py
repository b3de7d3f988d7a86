"""The Bernoulli restricted Boltzmann machine."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Generator, Tensor, nn

from memcomp_lightning.errors import require_count
from memcomp_lightning.models.init import Gaussian, Initialiser
from memcomp_lightning.rng import stream
from memcomp_lightning.types import Configurations


class RBM(nn.Module):
    r"""Visible and hidden units in {0, 1} with couplings between the two layers only.

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
    >>> rbm.energy(torch.zeros(5, 3), torch.zeros(5, 2)).tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0]
    """

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
        initialiser = Gaussian(std=0.01) if weight_init is None else weight_init
        generator = stream(0, "weights") if generator is None else generator
        self.weight = nn.Parameter(initialiser((*replicas, n_hidden, n_visible), generator=generator))
        self.b = nn.Parameter(torch.zeros(*replicas, n_visible))
        self.c = nn.Parameter(torch.zeros(*replicas, n_hidden))

    @property
    def n_visible(self) -> int:
        """Number of visible units."""
        return self.weight.shape[-1]

    @property
    def n_hidden(self) -> int:
        """Number of hidden units."""
        return self.weight.shape[-2]

    @property
    def replicas(self) -> tuple[int, ...]:
        """Leading axes of independent machines."""
        return tuple(self.weight.shape[:-2])

    def energy(
        self, v: Float[Tensor, "*replicas n n_visible"], h: Float[Tensor, "*replicas n n_hidden"]
    ) -> Float[Tensor, "*replicas n"]:
        """E(v, h) of each configuration (eq. 3)."""
        hidden_part = (self.hidden_field(v) * h).sum(-1)
        return -hidden_part - (v * self.b.unsqueeze(-2)).sum(-1)

    def mean_energy(self, configurations: Configurations) -> Float[Tensor, "*replicas"]:
        """Weighted mean of E over configurations.

        E is linear in the parameters, so the mean needs only the moments <h v>, <v> and <h>: one matrix
        product here, and none in its backward pass.
        """
        v, h, weight = configurations
        with torch.no_grad():
            if weight is None:
                moment, mean_v, mean_h = h.mT @ v / v.shape[-2], v.mean(-2), h.mean(-2)
            else:
                share = (weight / weight.sum(-1, keepdim=True)).unsqueeze(-1)
                moment, mean_v, mean_h = h.mT @ (v * share), (v * share).sum(-2), (h * share).sum(-2)
        return -((self.weight * moment).sum((-1, -2)) + (self.b * mean_v).sum(-1) + (self.c * mean_h).sum(-1))

    def free_energy(self, v: Float[Tensor, "*replicas n n_visible"]) -> Float[Tensor, "*replicas n"]:
        r"""F(v) = -b.v - \sum_i softplus(W v + c)_i, so that p(v) = exp(-F(v)) / Z."""
        return -F.softplus(self.hidden_field(v)).sum(-1) - (v * self.b.unsqueeze(-2)).sum(-1)

    def hidden_free_energy(self, h: Float[Tensor, "*replicas n n_hidden"]) -> Float[Tensor, "*replicas n"]:
        r"""F(h) = -c.h - \sum_j softplus(W^T h + b)_j, so that p(h) = exp(-F(h)) / Z."""
        return -F.softplus(self.visible_field(h)).sum(-1) - (h * self.c.unsqueeze(-2)).sum(-1)

    def hidden_field(self, v: Float[Tensor, "*replicas n n_visible"]) -> Float[Tensor, "*replicas n n_hidden"]:
        """W v + c, the log odds of each hidden unit."""
        return v @ self.weight.mT + self.c.unsqueeze(-2)

    def visible_field(self, h: Float[Tensor, "*replicas n n_hidden"]) -> Float[Tensor, "*replicas n n_visible"]:
        """W^T h + b, the log odds of each visible unit."""
        return h @ self.weight + self.b.unsqueeze(-2)

    def hidden_mean(
        self, v: Float[Tensor, "*replicas n n_visible"], *, beta: float = 1.0
    ) -> Float[Tensor, "*replicas n n_hidden"]:
        """p(h = 1 | v) at inverse temperature ``beta`` (eq. 7)."""
        return torch.sigmoid(beta * self.hidden_field(v))

    def visible_mean(
        self, h: Float[Tensor, "*replicas n n_hidden"], *, beta: float = 1.0
    ) -> Float[Tensor, "*replicas n n_visible"]:
        """p(v = 1 | h) at inverse temperature ``beta`` (eq. 8)."""
        return torch.sigmoid(beta * self.visible_field(h))

    def forward(self, v: Float[Tensor, "*replicas n n_visible"]) -> Float[Tensor, "*replicas n n_hidden"]:
        """The layer as part of a feed-forward network: p(h = 1 | v)."""
        return self.hidden_mean(v)
