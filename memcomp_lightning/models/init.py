"""Initial weights: small objects that draw a tensor of a given shape."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require


class Initialiser(Protocol):
    """Draws initial weights ``(*replicas, n_out, n_in)``."""

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Gaussian:
    """N(0, std^2)."""

    std: float = 0.01

    def __post_init__(self) -> None:
        require(self.std >= 0, "std", self.std, "a number >= 0")

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""
        return torch.empty(shape).normal_(0.0, self.std, generator=generator)


@dataclass(frozen=True, kw_only=True, slots=True)
class Uniform:
    """U[low, high)."""

    low: float
    high: float

    def __post_init__(self) -> None:
        require(self.low <= self.high, "low", self.low, f"a number <= high = {self.high}")

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""
        return torch.empty(shape).uniform_(self.low, self.high, generator=generator)


@dataclass(frozen=True, kw_only=True, slots=True)
class Xavier:
    """U[-a, a) with ``a = gain sqrt(6 / (n_in + n_out))`` (Glorot & Bengio 2010, eq. 16)."""

    gain: float = 1.0

    def __post_init__(self) -> None:
        require(self.gain > 0, "gain", self.gain, "a number > 0")

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""
        bound = self.gain * math.sqrt(6.0 / (shape[-1] + shape[-2]))
        return torch.empty(shape).uniform_(-bound, bound, generator=generator)
