"""What RBMs and Boltzmann machines share: numbers of units, and sums of the energy over configurations."""

from abc import abstractmethod
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from memcomp_lightning.ambient import in_own_dtypes
from memcomp_lightning.models.base import Hidden, PerReplica, PerState, Visible
from memcomp_lightning.objective import shares
from memcomp_lightning.types import Configurations


class Machine(nn.Module):
    """Units with biases, and couplings between pairs of them.

    The energy is linear in the parameters: a sum over configurations needs only the *moments*, the sums of what
    each parameter is multiplied with, and no product of matrices in its backward pass.
    """

    b: nn.Parameter
    c: nn.Parameter

    @property
    def n_visible(self) -> int:
        """Number of visible units."""
        return self.b.shape[-1]

    @property
    def n_hidden(self) -> int:
        """Number of hidden units."""
        return self.c.shape[-1]

    @property
    def n_units(self) -> int:
        """Number of all units."""
        return self.n_visible + self.n_hidden

    @property
    def replicas(self) -> tuple[int, ...]:
        """Leading axes of independent machines."""
        return tuple(self.b.shape[:-1])

    def mean_energy(self, configurations: Configurations) -> PerReplica:
        """Mean of E over configurations, by their weights."""
        return self.total_energy(configurations.v, configurations.h, shares(configurations))

    @in_own_dtypes
    def total_energy(self, v: Visible, h: Hidden, weight: PerState) -> PerReplica:
        """Weighted sum of E over configurations, constants to autograd; the weights may have any sign."""
        with torch.no_grad():
            moments = self._moments(v, h, weight)
        return self._energy_of(moments)

    @in_own_dtypes
    def centred_total_energy(
        self,
        v: Visible,
        h: Hidden,
        weight: PerState,
        visible_offset: Float[Tensor, "*replicas n_visible"],
        hidden_offset: Float[Tensor, "*replicas n_hidden"],
    ) -> PerReplica:
        """The value of :meth:`total_energy` for weights that add up to 0, with the gradient of centred units.

        (Montavon & Mueller 2012.)
        """
        with torch.no_grad():
            value = self.total_energy(v, h, weight)
            moments = self._centred_moments(v, h, weight, visible_offset, hidden_offset)
        surrogate = self._energy_of(moments)
        return value + (surrogate - surrogate.detach())

    @abstractmethod
    def _moments(self, v: Tensor, h: Tensor, weight: Tensor) -> Sequence[Tensor]:
        """Weighted sums over configurations of what the parameters are multiplied with."""

    @abstractmethod
    def _centred_moments(
        self, v: Tensor, h: Tensor, weight: Tensor, visible_offset: Tensor, hidden_offset: Tensor
    ) -> Sequence[Tensor]:
        """The same sums of the centred parametrisation, turned into those of the model's own parameters."""

    @abstractmethod
    def _energy_of(self, moments: Sequence[Tensor]) -> Tensor:
        """Minus the sum over the parameters of each one times its moment, ``(*replicas,)``."""
