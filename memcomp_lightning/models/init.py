"""Initial weights: small objects that draw a tensor of a given shape."""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel, Images
from memcomp_lightning.models.observed import check_observed
from memcomp_lightning.models.units import Bernoulli, Units
from memcomp_lightning.rng import stream


class Initialiser(Protocol):
    """Draws initial weights ``(*replicas, n_out, n_in)``."""

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape, drawn from ``generator``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Normal:
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
    draw = Normal(std=0.01) if weight_init is None else weight_init
    return draw(shape, generator=stream(0, "weights") if generator is None else generator)


def independent_bias(
    v: Images, visible: Units | None = None, observed: Tensor | None = None, weight: Tensor | None = None
) -> Float[Tensor, "*replicas n_visible"]:
    """Biases of units without couplings that have the data's means.

    Args:
        v: Data.
        visible: The kind of the units; None is units in {0, 1}, of which it is log (n_on + 1) / (n_off + 1).
        observed: A mask of the values that count; None is all of them.
        weight: How often each row counts, > 0, ``(*axes, n)``; None is once.

    >>> independent_bias(torch.tensor([[1.0, 0.0], [1.0, 1.0]]))
    tensor([1.0986, 0.0000])
    """
    visible = Bernoulli(v.shape[-1]) if visible is None else visible
    total, n, _ = _sums(v, observed, weight)
    return visible.bias_of(total, n)


@torch.no_grad()
def start_at_means(
    model: EnergyModel, v: Images, observed: Tensor | None = None, weight: Tensor | None = None
) -> None:
    """Set the visible biases of an energy model, in place, so that without couplings it has the data's means.

    Precisions of real units that are learned become those of the data. Hinton 2012, A Practical Guide to Training
    RBMs, section 8.1. The data may be without the model's replica axes.

    Args:
        model: The model.
        v: Data.
        observed: A mask of the values that count; None is all of them.
        weight: How often each row counts in the means, > 0, ``(*axes, n)``; None is once.

    Raises:
        SettingError: A value that the units do not take; a column of real units that is constant; a mask that
            hides a whole row or column.
    """
    visible = model.visible
    if observed is not None:
        check_observed(model, v, observed)
    visible.check(v, observed)
    if visible.real or observed is not None:
        total, n, variance = _sums(v, observed, weight)
        visible.start(total / n, variance)
    model.b.copy_(independent_bias(v, visible, observed, weight).expand(model.b.shape))


def _sums(
    v: Tensor, observed: Tensor | None, weight: Tensor | None = None
) -> tuple[Tensor, float | Tensor, Tensor]:
    """Of each column its sum, the number of values, and their variance; weights count as repeats do."""
    if observed is None and weight is None:
        constant = v.amax(-2) == v.amin(-2)  # its variance may be a rounding error
        return v.sum(-2), v.shape[-2], v.var(-2, correction=0).masked_fill(constant, 0.0)
    observed = torch.ones_like(v, dtype=torch.bool) if observed is None else observed
    counts = observed if weight is None else observed * weight.to(v.dtype).unsqueeze(-1)
    known, n = torch.where(observed, v, 0.0), counts.sum(-2).to(v.dtype)
    total, divisor = (counts * known).sum(-2), n.clamp(min=torch.finfo(v.dtype).tiny)
    deviation = torch.where(observed, v - (total / divisor).unsqueeze(-2), 0.0)
    high = torch.where(observed, v, -torch.inf).amax(-2)
    constant = high == torch.where(observed, v, torch.inf).amin(-2)
    return total, n, ((counts * deviation.square()).sum(-2) / divisor).masked_fill(constant, 0.0)


def _empty(shape: tuple[int, ...], generator: Generator) -> Tensor:
    """Single precision, on the device of the stream, whatever torch's defaults are."""
    return torch.empty(shape, dtype=torch.float32, device=generator.device)
