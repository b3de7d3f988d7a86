"""Block Gibbs sampling: of two layers in turn, or of the classes of any connectivity."""

from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.models.base import EnergyModel, Readout
from memcomp_lightning.types import Configurations

if TYPE_CHECKING:
    from memcomp_lightning.models.rbm import RBM


@torch.no_grad()
def sweep(model: "RBM", v: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
    """Draw h given v, then v given h, at inverse temperature ``beta``; return the new v.

    Leaves the distribution ``exp(-beta E) / Z(beta)`` invariant. Values of ``v`` between 0 and 1 are taken as
    they are in the first half of the sweep.
    """
    return _swept(model, v, beta, generator)[0]


def _swept(model: "RBM", v: Tensor, beta: float | Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
    h = rng.bernoulli(model.hidden_mean(v, beta=beta), generator=generator)
    return rng.bernoulli(model.visible_mean(h, beta=beta), generator=generator), h


def random_states(model: EnergyModel, n: int, n_units: int, *, generator: Generator) -> Tensor:
    """Draw n states of so many units a replica, each unit 0 or 1 with probability 1/2."""
    half = torch.full((*model.replicas, n, n_units), 0.5, dtype=model.b.dtype, device=model.b.device)
    return rng.bernoulli(half, generator=generator)


class TwoLayerChains:
    """Gibbs chains of an RBM; a state is its visible units, from which each sweep draws the hidden ones anew."""

    free_readout = True

    def __init__(self, model: "RBM") -> None:
        self._model = model

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw visible units."""
        return random_states(self._model, n, self._model.n_visible, generator=generator)

    def sweep(self, x: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
        """Draw h given v, then v given h."""
        return sweep(self._model, x, beta=beta, generator=generator)

    def swept_with_energy(self, x: Tensor, *, beta: float | Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Draw h given v, then v given h; the energy of both."""
        v, h = _swept(self._model, x, beta, generator)
        return v, self._model.energy(v, h)

    def read(self, x: Tensor) -> Configurations:
        """The visible units and the hidden means given them."""
        return Configurations(x, self._model.hidden_mean(x))

    def from_data(
        self, positive: Configurations, k: int, *, visible: Readout, hidden: Readout, generator: Generator
    ) -> Configurations:
        """The first half sweep takes the hidden means that the positive phase has computed already."""
        h = rng.bernoulli(positive.h, generator=generator)
        for _ in range(k - 1):
            v = rng.bernoulli(self._model.visible_mean(h), generator=generator)
            h = rng.bernoulli(self._model.hidden_mean(v), generator=generator)
        v = self._model.visible_mean(h)
        if visible == "sample":
            v = rng.bernoulli(v, generator=generator)
        h = self._model.hidden_mean(v)
        if hidden == "sample":
            h = rng.bernoulli(h, generator=generator)
        return Configurations(v, h, positive.weight)


class ClassChains:
    """Chains of all units of a model of any connectivity, class by class."""

    free_readout = False

    def __init__(self, model: EnergyModel) -> None:
        self._model = model
        self._blocks = model.blocks()

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw all units."""
        return random_states(self._model, n, self._model.n_units, generator=generator)

    def sweep(self, x: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
        """Draw each class given all others."""
        x = x.clone()
        for block in self._blocks:
            x[..., block.units] = rng.bernoulli(torch.sigmoid(beta * block.field(x)), generator=generator)
        return x

    def swept_with_energy(self, x: Tensor, *, beta: float | Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Sweep, and the energy of the new state."""
        x = self.sweep(x, beta=beta, generator=generator)
        return x, self._model.energy(*self._split(x))

    def read(self, x: Tensor) -> Configurations:
        """The states, the last class by its means."""
        x, last = x.clone(), self._blocks[-1]
        x[..., last.units] = torch.sigmoid(last.field(x))
        return Configurations(*self._split(x))

    def from_data(
        self, positive: Configurations, k: int, *, visible: Readout, hidden: Readout, generator: Generator
    ) -> Configurations:
        """Sweep all units from the data, with hidden units drawn by their means; read as by ``read``."""
        x = torch.cat((positive.v, rng.bernoulli(positive.h, generator=generator)), dim=-1)
        for _ in range(k):
            x = self.sweep(x, generator=generator)
        return self.read(x)._replace(weight=positive.weight)

    def _split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        n = self._model.n_visible
        return x[..., :n], x[..., n:]
