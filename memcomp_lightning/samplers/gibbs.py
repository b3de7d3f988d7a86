"""Block Gibbs sampling of a two-layer model."""

from typing import Protocol

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.types import Configurations


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
def positive_phase(model: TwoLayerModel, v: Tensor) -> Configurations:
    """Return data with the hidden means given them, ``E[h | v]``."""
    return Configurations(v, model.hidden_mean(v))


@torch.no_grad()
def sweep(model: TwoLayerModel, v: Tensor, *, beta: float = 1.0, generator: Generator) -> Tensor:
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
