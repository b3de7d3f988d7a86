"""What ``experiment=sampler_worth`` measures of RBMs between two passes: likelihood, and bias of the gradient."""

import copy
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.gradient_bias import MAX_UNITS, compared, gradient
from memcomp_lightning.errors import require
from memcomp_lightning.likelihood import (
    Ais,
    ReverseAis,
    base_of,
    base_on_first_class,
    kl_divergence,
    log_likelihood_or_bound,
    log_partition_function,
)
from memcomp_lightning.models import RBM, EnergyModel, as_two_layers
from memcomp_lightning.models.chains import sweep
from memcomp_lightning.samplers import Exact, ModeAssisted, positive_phase
from memcomp_lightning.training import Pass
from memcomp_lightning.training.diverged import LARGEST_WEIGHT
from memcomp_lightning.types import Configurations

FANTASY_SWEEPS = 200
"""Gibbs sweeps from training images to the samples from which reverse AIS starts."""


class Scores(NamedTuple):
    """Of each replica, ``(*replicas,)``: nats, less is better.

    Attributes:
        values: Divergence, or negative log-likelihood an image.
        reverse: The same with the partition function of reverse AIS; None where it is not estimated.
    """

    values: Tensor
    reverse: Tensor | None = None


Measure = Callable[[RBM], Scores]


def measure_of(name: str, data: Any, n_reported: int) -> Measure:
    """What scores RBMs by the images of a data module.

    Args:
        name: A key of :data:`MEASURES`.
        data: The data module.
        n_reported: So many replicas are scored by test images, the others by held-out training images, so that
            nothing is chosen by test images.

    Raises:
        SettingError: Nothing is held out, and the measure needs it.
    """
    return MEASURES[name](data, n_reported)


def _kl(data: Any, n_reported: int) -> Measure:
    """All there is to know is the data set itself, which every replica learns from."""
    v = data.images.train_v
    return lambda rbm: Scores(kl_divergence(rbm, v))


def _log_likelihood(data: Any, n_reported: int) -> Measure:
    negative = _negative_log_likelihood(data, n_reported)
    return lambda rbm: Scores(negative(rbm, log_partition_function(rbm)))


def _ais(data: Any, n_reported: int) -> Measure:
    """AIS reports too small a partition function and reverse AIS too large a one: they bracket the score."""
    negative, v = _negative_log_likelihood(data, n_reported), data.images.train_v
    base, ais = base_of(v), Ais()

    def measure(rbm: RBM) -> Scores:
        up = ais.estimate(rbm, generator=rng.stream(0, "ais"), base=base)
        start, generator = v[: ais.n_chains].expand(*rbm.replicas, -1, -1), rng.stream(0, "fantasies")
        two_layers, base_of_two, samples = _of_two_layers(rbm, base, start, generator)
        for _ in range(FANTASY_SWEEPS):
            samples = sweep(two_layers, samples, generator=generator)
        down = ReverseAis().estimate(two_layers, samples, generator=rng.stream(0, "reverse ais"), base=base_of_two)
        return Scores(negative(rbm, up.log_z), negative(rbm, down.log_z))

    return measure


MEASURES: Mapping[str, Callable[[Any, int], Measure]] = {
    "kl": _kl,
    "log_likelihood": _log_likelihood,
    "ais": _ais,
}
"""Exact divergence; exact log-likelihood (smaller layer up to 25 units); log-likelihood by AIS both ways."""


def _of_two_layers(
    model: EnergyModel, base: Tensor, v: Tensor, generator: Generator
) -> tuple[RBM, Tensor, Tensor]:
    """An RBM, its base and where its chains start; a DBM is the RBM between its odd and its even layers."""
    layers = as_two_layers(model)
    if layers.units is None:
        return layers.rbm, base, v
    x = torch.cat((v, rng.bernoulli(model.hidden_mean(v), generator=generator)), dim=-1)
    return layers.rbm, base_on_first_class(model, base), layers.first(x)


def _negative_log_likelihood(data: Any, n_reported: int) -> Callable[[RBM, Tensor], Tensor]:
    require(
        data.validation is not None,
        "data.validation_fraction",
        0.0,
        "above 0 where log-likelihoods are measured: held-out images choose the learning rates",
    )
    test_v, (held_out_v, _) = data.images.test_v, data.validation

    def negative(rbm: RBM, log_z: Tensor) -> Tensor:
        by_test, by_held_out = (-log_likelihood_or_bound(rbm, v, log_z).mean(-1) for v in (test_v, held_out_v))
        return torch.cat([by_test[:n_reported], by_held_out[n_reported:]])

    return negative


@torch.no_grad()
def without_diverged(rbm: RBM) -> tuple[RBM, Tensor]:
    """A copy in which replicas that left the finite numbers are zero, and which they are, ``(*replicas,)``."""
    n = len(rbm.replicas)
    largest = torch.stack([p.flatten(n).abs().amax(-1).nan_to_num(nan=math.inf) for p in rbm.parameters()]).amax(0)
    diverged = largest > LARGEST_WEIGHT
    kept = copy.deepcopy(rbm)
    for parameter in kept.parameters():
        parameter.masked_fill_(diverged.view((*diverged.shape, *[1] * (parameter.ndim - n))), 0.0)
    return kept, diverged


@torch.no_grad()
def gradient_bias(rbm: RBM, sampler: Any, done: Pass, n_draws: int) -> tuple[Tensor, Tensor]:
    """Cosine and relative error of a sampler's mean gradient against the exact one, ``(*replicas,)`` each.

    Of the mean over some draws from the sampler's present state: noise of the draws is small in it, that of where
    persistent chains are is not. NaN where the model is too large, and where one of its layers is in training.
    """
    exact, generator = Exact(max_units=MAX_UNITS), rng.stream(done.number, "gradient bias")
    sizes = (done.positive.v.shape[-1], done.positive.h.shape[-1])
    if rbm.n_enumerated > exact.max_units or sizes != (rbm.n_visible, rbm.n_hidden):
        nothing = torch.full(rbm.replicas, math.nan)
        return nothing, nothing
    # Where hidden units are coupled to each other, the sampler of the positive phase has chosen them.
    independent = rbm.quadratic_form().pairs is None
    positive = positive_phase(rbm, done.positive.v) if independent else done.positive
    true = mean_gradient(rbm, exact, exact.init(rbm, 1, generator=generator), positive, 1, generator=generator)
    mean = mean_gradient(rbm, sampler, done.state, positive, n_draws, generator=generator)
    return compared(mean, true)


def mean_gradient(
    rbm: RBM, sampler: Any, state: Any, positive: Configurations, n_draws: int, *, generator: Generator
) -> Tensor:
    """The mean over draws from one state; the coin of mode assistance is not tossed, both sides are weighed."""

    def drawn(sample: Any, state: Any) -> Tensor:
        return gradient(rbm, positive, sample(rbm, state, positive, generator=generator).configurations).double()

    if isinstance(sampler, ModeAssisted):
        p = sampler.schedule.probability(int(state.n_done))
        ordinary = mean_gradient(rbm, sampler.inner, state.inner, positive, n_draws, generator=generator)
        return (1 - p) * ordinary + p * drawn(sampler.sample_mode, state)
    return torch.stack([drawn(sampler.sample, state) for _ in range(1 if sampler.shared else n_draws)]).mean(0)
