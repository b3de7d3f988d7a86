"""What a measure of trained models is: nats of each replica, less is better."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning.data import ImageDataModule
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import log_likelihood_or_bound
from memcomp_lightning.models import EnergyModel


class Scores(NamedTuple):
    """Of each replica, ``(*replicas,)``: nats, less is better.

    Attributes:
        values: Divergence, or negative log-likelihood an image.
        reverse: The same with the partition function of reverse AIS; None where it is not estimated.
    """

    values: Tensor
    reverse: Tensor | None = None


Scoring = Callable[[EnergyModel], Scores]
"""Scores models, all replicas side by side."""


@dataclass(frozen=True)
class Measure:
    """How models are scored.

    Attributes:
        make: Makes the scoring from a data module and the number of replicas that are reported. These are scored
            by test images, the others by held-out training images, so that nothing is chosen by test images.
        title: What is scored, with its unit, for charts.
        is_exact: Whether it sums over all states, and refuses models that have too many.
        is_divergence: Whether 0 is the best there is, so that a logarithmic axis shows the approach to it.
        both_ways: Whether the scores have a second estimate, by reverse AIS.
    """

    make: Callable[[ImageDataModule, int], Scoring]
    title: str
    is_exact: bool = False
    is_divergence: bool = False
    both_ways: bool = False


def negative_log_likelihood(data: ImageDataModule, n_reported: int) -> Callable[[EnergyModel, Tensor], Tensor]:
    """Negative log-likelihood of each replica, given its log Z; see :class:`Measure`. Images must be held out."""
    if data.validation is None:
        allowed = "above 0 where log-likelihoods are measured: held-out images choose the learning rates"
        raise SettingError(f"data.validation_fraction = 0.0 is not allowed: expected {allowed}.")
    (test_v, _), (held_out_v, _) = data.test, data.validation

    def negative(model: EnergyModel, log_z: Tensor) -> Tensor:
        by_test, by_held_out = (-log_likelihood_or_bound(model, v, log_z).mean(-1) for v in (test_v, held_out_v))
        return torch.cat([by_test[:n_reported], by_held_out[n_reported:]])

    return negative
