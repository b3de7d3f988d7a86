"""An RBM as seen from its smaller layer, the one that is enumerated."""

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.rbm import RBM

MOST_UNITS = 32

NUMBERS = 2**23
"""float64 numbers held at a time."""

PAIRS_PER_S = 5e9
"""Pairs of an enumerated state and a unit of the other layer that one CPU thread does in a second."""


class Layers(NamedTuple):
    """An RBM as seen from its smaller layer, in float64, replicas on one axis.

    Attributes:
        weight: ``(n_replicas, n_other, n_enumerated)``.
        enumerated: Bias of the smaller layer, ``(n_replicas, n_enumerated)``.
        other: Bias of the other layer, ``(n_replicas, n_other)``.
        hidden_first: Whether the smaller layer is the hidden one.
    """

    weight: Tensor
    enumerated: Tensor
    other: Tensor
    hidden_first: bool

    @property
    def n_other(self) -> int:
        """Number of units of the other layer."""
        return self.weight.shape[-2]

    @property
    def n_enumerated(self) -> int:
        """Number of units of the smaller layer."""
        return self.weight.shape[-1]

    def part(self, at: slice | int) -> "Layers":
        """Some of the replicas; one of them without its axis."""
        return Layers(self.weight[at], self.enumerated[at], self.other[at], self.hidden_first)


def layers_of(model: RBM) -> Layers:
    """Look at an RBM from its smaller layer."""
    hidden_first = model.n_hidden < model.n_visible
    weight = model.weight.detach().double().reshape(-1, model.n_hidden, model.n_visible)
    b, c = (bias.detach().double().reshape(weight.shape[0], -1) for bias in (model.b, model.c))
    return Layers(weight.mT, c, b, True) if hidden_first else Layers(weight, b, c, False)


def enumerable(model: RBM, max_units: int) -> Layers:
    """The model from its smaller layer, if that may be enumerated."""
    require_count("max_units", max_units)
    require(max_units <= MOST_UNITS, "max_units", max_units, f"an integer from 1 to {MOST_UNITS}")
    layers = layers_of(model)
    n, n_other, n_threads = layers.n_enumerated, layers.n_other, torch.get_num_threads()
    seconds = len(layers.weight) * 2.0 ** min(n, 999) * n_other / (PAIRS_PER_S * n_threads)
    require(
        n <= max_units,
        "size of the smaller layer",
        n,
        f"at most max_units = {max_units} to enumerate a {model.n_visible}x{model.n_hidden} RBM",
        f"All its states would take about {_duration(seconds)} on {n_threads} CPU threads: raise max_units (at "
        f"most {MOST_UNITS}) if you can wait, or estimate log Z (Ais).",
    )
    require_finite(model)
    return layers


def require_finite(model: EnergyModel) -> None:
    """Raise unless all parameters are finite."""
    for name, parameter in model.named_parameters():
        finite = bool(parameter.isfinite().all())
        require(finite, name, "not finite", "finite numbers", "Training diverged: use a smaller learning rate.")


def log_weights(
    layers: Layers, prefixes: Float[Tensor, "#replicas prefixes n_first"], second: Float[Tensor, "states n_second"]
) -> Float[Tensor, "replicas prefixes states"]:
    """Log weights of all states (t, u) in float64, without any constant left out."""
    n_first = prefixes.shape[-1]
    of_prefixes = prefixes @ layers.weight[..., :n_first].mT + layers.other.unsqueeze(-2)
    of_second = second @ layers.weight[..., n_first:].mT
    field = of_prefixes.unsqueeze(-2) + of_second.unsqueeze(-3)
    bias = (prefixes @ layers.enumerated[..., :n_first, None]) + (
        second @ layers.enumerated[..., n_first:, None]
    ).mT
    return softplus(field).sum(-1) + bias


def softplus(x: Tensor) -> Tensor:
    """log(1 + exp(x)) to all digits: torch's own threshold of 20 leaves out 2e-9."""
    return F.softplus(x, threshold=40.0)


def in_chunks(function: Callable[[Tensor], Tensor], v: Tensor, numbers_a_row: int) -> Tensor:
    """Apply a function of rows, in float64, to so many rows at a time that about ``NUMBERS`` numbers are held."""
    n_replicas = max(1, v[..., :1, :1].numel())
    rows = max(1, NUMBERS // (n_replicas * numbers_a_row))
    return torch.cat([function(part.double()) for part in v.split(rows, dim=-2)], dim=len(v.shape) - 2)


def _duration(seconds: float) -> str:
    """A time with one or two digits."""
    for size, unit in ((3.156e7, "years"), (86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= size:
            return f"{seconds / size:.2g} {unit}"
    return f"{seconds:.1g} seconds"
