"""Bias of a sampler's gradient, of models small enough to enumerate."""

import copy
import math
from typing import Any

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.gradient_bias import MAX_UNITS, compared, gradient
from memcomp_lightning.models import EnergyModel
from memcomp_lightning.samplers import Exact, ModeAssisted, positive_phase
from memcomp_lightning.training import Pass
from memcomp_lightning.training.diverged import LARGEST_WEIGHT
from memcomp_lightning.types import Configurations


@torch.no_grad()
def without_diverged(model: EnergyModel) -> tuple[EnergyModel, Tensor]:
    """A copy in which replicas that left the finite numbers are zero, and which they are, ``(*replicas,)``."""
    n = len(model.replicas)
    largest = [p.flatten(n).abs().amax(-1).nan_to_num(nan=math.inf) for p in model.parameters()]
    diverged = torch.stack(largest).amax(0) > LARGEST_WEIGHT
    kept = copy.deepcopy(model)
    for parameter in kept.parameters():
        parameter.masked_fill_(diverged.view((*diverged.shape, *[1] * (parameter.ndim - n))), 0.0)
    return kept, diverged


@torch.no_grad()
def gradient_bias(model: EnergyModel, sampler: Any, done: Pass, n_draws: int) -> tuple[Tensor, Tensor]:
    """Cosine and relative error of a sampler's mean gradient against the exact one, ``(*replicas,)`` each.

    The mean is over ``n_draws`` draws from the sampler's present state: that averages out the noise of draws, but
    not that of where persistent chains happen to be. NaN where the model is too large to enumerate, and while a
    single layer of it is in training.
    """
    exact, generator = Exact(max_units=MAX_UNITS), rng.stream(done.number, "gradient bias")
    sizes = (done.positive.v.shape[-1], done.positive.h.shape[-1])
    if model.n_enumerated > exact.max_units or sizes != (model.n_visible, model.n_hidden):
        nothing = torch.full(model.replicas, math.nan)
        return nothing, nothing
    # Where hidden units are coupled to each other, the sampler of the positive phase has chosen them.
    independent = model.quadratic_form().pairs is None
    positive = positive_phase(model, done.positive.v) if independent else done.positive
    true = mean_gradient(model, exact, exact.init(model, 1, generator=generator), positive, 1, generator=generator)
    mean = mean_gradient(model, sampler, done.state, positive, n_draws, generator=generator)
    return compared(mean, true)


def mean_gradient(
    model: EnergyModel, sampler: Any, state: Any, positive: Configurations, n_draws: int, *, generator: Generator
) -> Tensor:
    """The mean gradient over draws from one state; mode assistance counts both of its updates by probability."""

    def drawn(sample: Any, state: Any) -> Tensor:
        negative = sample(model, state, positive, generator=generator).configurations
        return gradient(model, positive, negative).double()

    if isinstance(sampler, ModeAssisted):
        p = sampler.schedule.probability(int(state.n_done))
        ordinary = mean_gradient(model, sampler.inner, state.inner, positive, n_draws, generator=generator)
        return (1 - p) * ordinary + p * drawn(sampler.sample_mode, state)
    return torch.stack([drawn(sampler.sample, state) for _ in range(1 if sampler.shared else n_draws)]).mean(0)
