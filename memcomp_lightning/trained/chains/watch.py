"""What is recorded along chains, to see whether they mix."""

from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from memcomp_lightning.models import RBM, EnergyModel

N_DIRECTIONS = 3
"""Leading principal components that are watched, of states and of means of chains."""


@dataclass(frozen=True, eq=False)
class Watch:
    """Statistics of a state: its free energy (its energy, if it has hidden units) and some projections.

    Attributes:
        model: Whose states they are.
        directions: In the space of the visible units, ``(n_visible, n_directions)``.
    """

    model: EnergyModel
    directions: Tensor

    @classmethod
    def of(cls, model: EnergyModel, x: Tensor, n_chains_of_row: int) -> Self:
        """Watch the leading principal components of states of all chains, and those of the means of chains.

        Chains that stay in different modes differ most in what tells the modes apart, even where few chains are in
        one of them.

        Args:
            model: Whose states they are.
            x: States ``(n_looks, n_chains, n_units)``.
            n_chains_of_row: Chains that share what is known, side by side: what differs between rows is left out.
        """
        v = x[..., : model.n_visible].double().cpu()
        v = v.unflatten(1, (-1, n_chains_of_row))
        v = v - v.mean((0, 2), keepdim=True)
        of_states, of_means = _leading(v.flatten(0, 2)), _leading(v.mean(0).flatten(0, 1))
        return cls(model, torch.cat((of_states, of_means), dim=-1).to(x))

    def __call__(self, x: Tensor) -> Tensor:
        """Statistics of states ``(n, n_units)``, ``(n, n_statistics)`` float64 on the CPU."""
        model, n = self.model, self.model.n_visible
        v, h = x[:, :n], x[:, n:]
        alone = isinstance(model, RBM) and x.shape[-1] == n
        energy = model.free_energy(v) if alone else model.energy(v, h)
        return torch.cat((energy.unsqueeze(-1), v @ self.directions), dim=-1).double().cpu()


def _leading(v: Tensor) -> Tensor:
    """Leading principal components of rows, ``(n_visible, n_directions)``."""
    if len(v) > v.shape[-1]:
        vectors = torch.linalg.eigh(v.mT @ v)[1].flip(-1)
    else:
        vectors = v.mT @ torch.linalg.eigh(v @ v.mT)[1].flip(-1)
    leading: Tensor = vectors[:, :N_DIRECTIONS]
    return leading
