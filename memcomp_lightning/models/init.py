"""Initial weights: small objects that draw a tensor of a given shape."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel, Images
from memcomp_lightning.rng import stream


class Initialiser(Protocol):
    """Draws initial weights ``(*replicas, n_out, n_in)``."""

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Gaussian:
    """N(0, std^2)."""

    std: float = 0.01

    def __post_init__(self) -> None:
        require(self.std >= 0, "std", self.std, "a number >= 0")

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""
        return _empty(shape, generator).normal_(0.0, self.std, generator=generator)


@dataclass(frozen=True, kw_only=True, slots=True)
class Uniform:
    """U[low, high)."""

    low: float
    high: float

    def __post_init__(self) -> None:
        require(self.low <= self.high, "low", self.low, f"a number <= high = {self.high}")

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""
        return _empty(shape, generator).uniform_(self.low, self.high, generator=generator)


@dataclass(frozen=True, kw_only=True, slots=True)
class Xavier:
    """U[-a, a) with ``a = gain sqrt(6 / (n_in + n_out))`` (Glorot & Bengio 2010, eq. 16)."""

    gain: float = 1.0

    def __post_init__(self) -> None:
        require(self.gain > 0, "gain", self.gain, "a number > 0")

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""
        bound = self.gain * math.sqrt(6.0 / (shape[-1] + shape[-2]))
        return _empty(shape, generator).uniform_(-bound, bound, generator=generator)


def initial(shape: tuple[int, ...], weight_init: Initialiser | None, generator: Generator | None) -> Tensor:
    """Initial weights, by default N(0, 0.01^2) from a fresh stream of seed 0."""
    draw = Gaussian(std=0.01) if weight_init is None else weight_init
    return draw(shape, generator=stream(0, "weights") if generator is None else generator)


def mean_log_odds(v: Images) -> Float[Tensor, "*axes n_visible"]:
    """Biases of independent units that have the data's means: log (n_on + 1) / (n_off + 1).

    >>> mean_log_odds(torch.tensor([[1.0, 0.0], [1.0, 1.0]]))
    tensor([1.0986, 0.0000])
    """
    n_on = v.sum(-2)
    return torch.log((n_on + 1) / (v.shape[-2] - n_on + 1))


@torch.no_grad()
def start_at_means(model: EnergyModel, v: Images) -> None:
    """Set the visible biases of an energy model, in place, so that without couplings it has the data's means.

    Hinton 2012, A Practical Guide to Training RBMs, section 8.1. The data may be without the model's replica axes.
    """
    model.b.copy_(mean_log_odds(v).expand(model.b.shape))


def _empty(shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Single precision, on the device of the stream, whatever torch's defaults are."""
    return torch.empty(shape, dtype=torch.float32, device=generator.device)
