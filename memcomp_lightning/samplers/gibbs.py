"""Block Gibbs sampling: of two layers in turn, or of the classes of any connectivity."""

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.types import Configurations


class PositivePhaseModel(Protocol):
    """What has hidden means given data."""

    def hidden_mean(self, v: Tensor) -> Tensor:
        """E[h | v]."""
        ...


class TwoLayerModel(Protocol):
    """An energy model with conditionally independent layers, as the Gibbs samplers see it."""

    @property
    def replicas(self) -> tuple[int, ...]:
        """Leading axes."""
        ...

    @property
    def n_visible(self) -> int:
        """Number of visible units."""
        ...

    @property
    def b(self) -> Tensor:
        """Visible bias; gives dtype and device."""
        ...

    def hidden_mean(self, v: Tensor, *, beta: float | Tensor = 1.0) -> Tensor:
        """p(h = 1 | v)."""
        ...

    def visible_mean(self, h: Tensor, *, beta: float | Tensor = 1.0) -> Tensor:
        """p(v = 1 | h)."""
        ...


@torch.no_grad()
def positive_phase(model: PositivePhaseModel, v: Tensor) -> Configurations:
    """Return data with the hidden means given them, ``E[h | v]``."""
    return Configurations(v, model.hidden_mean(v))


@torch.no_grad()
def sweep(model: TwoLayerModel, v: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
    """Draw h given v, then v given h, at inverse temperature ``beta``; return the new v.

    Leaves ``p(v)^beta``-tempered equilibrium, ``exp(-beta E) / Z(beta)``, invariant. Real-valued ``v`` is
    taken as it is in the first half of the sweep.
    """
    h = rng.bernoulli(model.hidden_mean(v, beta=beta), generator=generator)
    return rng.bernoulli(model.visible_mean(h, beta=beta), generator=generator)


def random_visible(model: TwoLayerModel, n: int, *, generator: Generator) -> Tensor:
    """Draw n visible states a replica, each unit 0 or 1 with probability 1/2."""
    half = torch.full((*model.replicas, n, model.n_visible), 0.5, dtype=model.b.dtype, device=model.b.device)
    return rng.bernoulli(half, generator=generator)


class Chains(Protocol):
    """Gibbs chains of one model at its present parameters, whatever its connectivity.

    A chain's state is ``x``, ``(*replicas, n, n_units)``: the visible units of a two-layer model, whose hidden
    ones are redrawn from them; all units otherwise.
    """

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw n states a replica, each unit 0 or 1 with probability 1/2."""
        ...

    def sweep(self, x: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
        """Draw every unit once given the others, at inverse temperature ``beta``, a number or ``(..., n, 1)``."""
        ...

    def swept_with_energy(self, x: Tensor, *, beta: float | Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Sweep, and return the energy of the new joint state as well, ``(*replicas, n)``."""
        ...

    def read(self, x: Tensor) -> Configurations:
        """The states, with the class that was drawn last by its means given the others."""
        ...


class TwoLayerChains:
    """Chains of visible units.

    Args:
        model: The model.
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw visible units."""
        return random_visible(self._model, n, generator=generator)

    def sweep(self, x: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
        """Draw h given v, then v given h."""
        return sweep(self._model, x, beta=beta, generator=generator)

    def swept_with_energy(self, x: Tensor, *, beta: float | Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Draw h given v, then v given h; the energy of both."""
        h = rng.bernoulli(self._model.hidden_mean(x, beta=beta), generator=generator)
        v = rng.bernoulli(self._model.visible_mean(h, beta=beta), generator=generator)
        return v, self._model.energy(v, h)

    def read(self, x: Tensor) -> Configurations:
        """The visible units and the hidden means given them."""
        return Configurations(x, self._model.hidden_mean(x))


class ClassChains:
    """Chains of all units, class by class.

    Args:
        model: A model with ``blocks()``, as :class:`memcomp_lightning.models.BoltzmannMachine`.
    """

    def __init__(self, model: Any) -> None:
        self._model = model
        self._blocks: Sequence[Any] = model.blocks()

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw all units."""
        b = self._model.b
        n_units = self._model.n_visible + self._model.n_hidden
        half = torch.full((*self._model.replicas, n, n_units), 0.5, dtype=b.dtype, device=b.device)
        return rng.bernoulli(half, generator=generator)

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

    def _split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        n = self._model.n_visible
        return x[..., :n], x[..., n:]


def has_classes(model: Any) -> bool:
    """Whether a model is one of any connectivity, drawn class by class."""
    return hasattr(model, "blocks")


def chains_of(model: Any) -> Chains:
    """The chains of a model: class by class if it has ``blocks()``, otherwise layer by layer."""
    return ClassChains(model) if has_classes(model) else TwoLayerChains(model)
