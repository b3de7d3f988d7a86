"""Samplers of the positive phase: hidden units given the data, where they are coupled to each other."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.mean_field import hidden_blocks, mean_field
from memcomp_lightning.types import Configurations


class PositivePhase(NamedTuple):
    """What a sampler of the positive phase returns.

    Attributes:
        configurations: Data with hidden units that stand for p(h | v).
        info: Diagnostics, ``(*replicas,)`` each.
    """

    configurations: Configurations
    info: dict[str, Tensor]


class PositivePhaseSampler(Protocol):
    """Supplies the expectation over hidden units with the data clamped."""

    def sample(self, model: EnergyModel, v: Tensor, *, generator: Generator) -> PositivePhase:
        """Return configurations for data ``(*replicas, n, n_visible)`` in [0, 1]."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ClampedGibbs:
    """Gibbs chains of the hidden units with the visible ones clamped; the class drawn last is kept as means.

    Attributes:
        k: Sweeps from a random start, >= 1.
        n_chains: For each image, >= 1.
    """

    k: int = 10
    n_chains: int = 1

    def __post_init__(self) -> None:
        require_count("k", self.k)
        require_count("n_chains", self.n_chains)

    @torch.no_grad()
    def sample(self, model: EnergyModel, v: Tensor, *, generator: Generator) -> PositivePhase:
        """Return ``n_chains`` configurations an image."""
        v = v.repeat_interleave(self.n_chains, dim=-2)
        half = v.new_full((*v.shape[:-1], model.n_hidden), 0.5)
        x = torch.cat((v, rng.bernoulli(half, generator=generator)), dim=-1)
        blocks = hidden_blocks(model)
        for _ in range(self.k):
            for block in blocks:
                x[..., block.units] = rng.bernoulli(torch.sigmoid(block.field(x)), generator=generator)
        for last in blocks[-1:]:  # none in a machine without hidden units
            x[..., last.units] = torch.sigmoid(last.field(x))
        return PositivePhase(Configurations(v, x[..., model.n_visible :]), {})


@dataclass(frozen=True, kw_only=True, slots=True)
class ExactPosterior:
    """Every state of the hidden units with its probability given the data.

    Attributes:
        max_units: Hidden units at most, 1 to 16: 2^max_units configurations an image.
    """

    max_units: int = 16

    def __post_init__(self) -> None:
        require_count("max_units", self.max_units)
        require(self.max_units <= 16, "max_units", self.max_units, "an integer from 1 to 16")

    @torch.no_grad()
    def sample(self, model: EnergyModel, v: Tensor, *, generator: Generator) -> PositivePhase:
        """Return all configurations, those of an image with weights that add up to one.

        Raises:
            SettingError: The model has more hidden units.
        """
        n = model.n_hidden
        require(n <= self.max_units, "number of hidden units", n, f"at most max_units = {self.max_units}")
        h = binary_states(n, like=v)
        n_images, n_states = v.shape[-2], len(h)
        v = v.repeat_interleave(n_states, dim=-2)
        h = h.repeat(n_images, 1).expand(*v.shape[:-1], n)
        log_weight = -model.energy(v, h).double().unflatten(-1, (n_images, n_states))
        weight = torch.softmax(log_weight, dim=-1).flatten(-2).to(v.dtype)
        return PositivePhase(Configurations(v, h, weight), {})


@dataclass(frozen=True, kw_only=True, slots=True)
class MeanField:
    """Factorised p(h | v), by :func:`memcomp_lightning.models.mean_field`.

    Training then follows a lower bound of the likelihood. ``info`` says for each replica whether it converged
    ("mean_field_converged"), the last change of a mean and the iterations.

    Attributes:
        max_iterations: >= 1; without convergence by then, the last means are used.
        tolerance: Largest change of a mean that counts as converged, > 0.
    """

    max_iterations: int = 30
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        require_count("max_iterations", self.max_iterations)
        require(self.tolerance > 0, "tolerance", self.tolerance, "a number > 0")

    def sample(self, model: EnergyModel, v: Tensor, *, generator: Generator) -> PositivePhase:
        """Return the means; draws nothing."""
        found = mean_field(model, v, max_iterations=self.max_iterations, tolerance=self.tolerance)
        info = {
            "mean_field_converged": found.converged.to(v.dtype),
            "mean_field_change": found.change,
            "mean_field_iterations": torch.full_like(found.change, float(found.n_iterations)),
        }
        return PositivePhase(Configurations(v, found.h), info)
