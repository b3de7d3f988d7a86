"""Block Gibbs sampling: of two layers in turn, or of the classes of any connectivity."""

from typing import TYPE_CHECKING

import torch
from torch import Generator, Tensor

from memcomp_lightning.models.base import EnergyModel, Readout
from memcomp_lightning.models.one_by_one import in_runs
from memcomp_lightning.models.units import Units, side_by_side
from memcomp_lightning.types import Configurations

if TYPE_CHECKING:
    from memcomp_lightning.models.rbm import RBM


@torch.no_grad()
def sweep(model: "RBM", v: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
    """Draw h given v, then v given h, at inverse temperature ``beta``; return the new v.

    Leaves the distribution ``exp(-beta E) / Z(beta)`` invariant. Values of ``v`` between 0 and 1 are taken as
    they are in the first half of the sweep.
    """
    return swept(model, v, beta=beta, generator=generator)[0]


@torch.no_grad()
def swept(model: "RBM", v: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> tuple[Tensor, Tensor]:
    """As :func:`sweep`; return the new v, and the h that it was drawn from."""
    h = model.draw_hidden(v, beta=beta, generator=generator)
    return model.draw_visible(h, beta=beta, generator=generator), h


def random_states(model: EnergyModel, units: Units, n: int, *, generator: Generator) -> Tensor:
    """Draw n states of some units a replica without fields: as at infinite temperature."""
    return units.sample(model.b.new_zeros(*model.replicas, n, units.n), generator=generator)


class TwoLayerChains:
    """Gibbs chains of an RBM; a state is its visible units, from which each sweep draws the hidden ones anew."""

    free_readout = True

    def __init__(self, model: "RBM") -> None:
        self._model = model

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw visible units."""
        return random_states(self._model, self._model.visible, n, generator=generator)

    def sweep(self, x: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
        """Draw h given v, then v given h."""
        return sweep(self._model, x, beta=beta, generator=generator)

    def swept_with_energy(self, x: Tensor, *, beta: float | Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Draw h given v, then v given h; the energy of both that beta multiplies."""
        v, h = swept(self._model, x, beta=beta, generator=generator)
        return v, self._model.tempered_energy(v, h)

    def read(self, x: Tensor) -> Configurations:
        """The visible units and the hidden means given them."""
        return Configurations(x, self._model.hidden_mean(x))

    def from_data(
        self, positive: Configurations, k: int, *, visible: Readout, hidden: Readout, generator: Generator
    ) -> Configurations:
        """The first half sweep takes the hidden means that the positive phase has computed already."""
        model = self._model
        known = model.hidden.sample_of_mean(positive.h, generator=generator)
        h = model.draw_hidden(positive.v, generator=generator) if known is None else known
        for _ in range(k - 1):
            v = model.draw_visible(h, generator=generator)
            h = model.draw_hidden(v, generator=generator)
        v = model.visible_mean(h) if visible == "mean" else model.draw_visible(h, generator=generator)
        h = model.hidden_mean(v) if hidden == "mean" else model.draw_hidden(v, generator=generator)
        return Configurations(v, h, positive.weight)


class ClassChains:
    """Chains of all units of a model of any connectivity, class by class."""

    free_readout = False

    def __init__(self, model: EnergyModel) -> None:
        self._model = model
        self._blocks = model.blocks()
        self._runs = in_runs(self._blocks)

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw all units."""
        return random_states(
            self._model, side_by_side(self._model.visible, self._model.hidden), n, generator=generator
        )

    def sweep(self, x: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
        """Draw each class given all others."""
        x = x.clone()
        for run in self._runs:
            run.draw(x, beta, None, generator=generator)
        return x

    def swept_with_energy(self, x: Tensor, *, beta: float | Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Sweep, and the energy of the new state."""
        x = self.sweep(x, beta=beta, generator=generator)
        return x, self._model.tempered_energy(*self._split(x))

    def read(self, x: Tensor) -> Configurations:
        """The states, the last class by its means, unless its units are real."""
        x, last = x.clone(), self._blocks[-1]
        if last.kind.linear:
            x.index_copy_(-1, last.units, last.kind.mean(last.field(x)))
        return Configurations(*self._split(x))

    def from_data(
        self, positive: Configurations, k: int, *, visible: Readout, hidden: Readout, generator: Generator
    ) -> Configurations:
        """Sweep all units from the data, with hidden units drawn by their means; read as by ``read``."""
        drawn = self._model.hidden.sample_of_mean(positive.h, generator=generator)
        x = torch.cat((positive.v, positive.h if drawn is None else drawn), dim=-1)
        for _ in range(k):
            x = self.sweep(x, generator=generator)
        return self.read(x)._replace(weight=positive.weight)

    def _split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        n = self._model.n_visible
        return x[..., :n], x[..., n:]
