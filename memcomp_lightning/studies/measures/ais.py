"""Log-likelihood by annealed importance sampling in both directions."""

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.data import ImageDataModule
from memcomp_lightning.likelihood import Ais, ReverseAis, base_of, base_on_first_class
from memcomp_lightning.models import RBM, EnergyModel, as_two_layers
from memcomp_lightning.models.chains import sweep
from memcomp_lightning.studies.measures.base import Measure, Scores, Scoring, negative_log_likelihood

FANTASY_SWEEPS = 200
"""Gibbs sweeps from training images to the samples from which reverse AIS starts."""


def scoring(data: ImageDataModule, n_reported: int) -> Scoring:
    """Score by AIS, whose log Z tends to be too small, and by reverse AIS, whose log Z tends to be too large."""
    negative, v = negative_log_likelihood(data, n_reported), data.values_of(data.images.train_v)
    annealing = Ais()

    def measure(model: EnergyModel) -> Scores:
        base = base_of(v, model.visible)
        up = annealing.estimate(model, generator=rng.stream(0, "ais"), base=base)
        start, generator = v[: annealing.n_chains].expand(*model.replicas, -1, -1), rng.stream(0, "fantasies")
        two_layers, base_of_two, samples = _of_two_layers(model, base, start, generator)
        for _ in range(FANTASY_SWEEPS):
            samples = sweep(two_layers, samples, generator=generator)
        down = ReverseAis().estimate(two_layers, samples, generator=rng.stream(0, "reverse ais"), base=base_of_two)
        return Scores(negative(model, up.log_z), negative(model, down.log_z))

    return measure


AIS = Measure(scoring, "negative log-likelihood by AIS, nats", both_ways=True)


def _of_two_layers(
    model: EnergyModel, base: Tensor, v: Tensor, generator: Generator
) -> tuple[RBM, Tensor, Tensor]:
    """An RBM, its base and where its chains start; a DBM is the RBM between its odd and its even layers."""
    layers = as_two_layers(model)
    if layers.units is None:
        return layers.rbm, base, v
    x = torch.cat((v, model.hidden.values_of(model.hidden_mean(v), generator=generator)), dim=-1)
    return layers.rbm, base_on_first_class(model, base), layers.first(x)
