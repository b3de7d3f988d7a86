"""Controls that destroy what pretraining learned and keep the size of the weights, to see which of them helps."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.models.dbn import DBN


class Randomiser(Protocol):
    """Changes the parameters of a network in place."""

    def __call__(self, dbn: DBN, *, generator: Generator) -> None:
        """Change each layer of each replica on its own."""


@dataclass(frozen=True, slots=True)
class Shuffled:
    """Permute the entries of each weight matrix and of each bias: their distribution stays, their places go."""

    @torch.no_grad()
    def __call__(self, dbn: DBN, *, generator: Generator) -> None:
        """Change each layer of each replica on its own."""
        for values in _vectors(dbn):
            order = rng.uniform(values.shape, generator=generator, like=values).argsort(-1)
            values.copy_(values.gather(-1, order))


@dataclass(frozen=True, slots=True)
class GaussianMoments:
    """Draw each weight matrix and each bias from the Gaussian of its own mean and standard deviation."""

    @torch.no_grad()
    def __call__(self, dbn: DBN, *, generator: Generator) -> None:
        """Change each layer of each replica on its own."""
        for values in _vectors(dbn):
            empty = torch.empty(values.shape, dtype=values.dtype, device=generator.device)
            draw = empty.normal_(generator=generator).to(values.device)
            values.copy_(values.mean(-1, keepdim=True) + values.std(-1, correction=0, keepdim=True) * draw)


def _vectors(dbn: DBN) -> Iterator[Tensor]:
    """Every weight matrix, visible and hidden bias, ``(*replicas, n_entries)``; views of the parameters."""
    for rbm in dbn:
        yield rbm.weight.detach().view(*rbm.replicas, -1)
        yield rbm.b.detach()
        yield rbm.c.detach()
