"""What a measure of trained models is: nats of each replica, less is better."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.likelihood import log_likelihood_or_bound
from memcomp_lightning.models import RBM


class Scores(NamedTuple):
    """Of each replica, ``(*replicas,)``: nats, less is better.

    Attributes:
        values: Divergence, or negative log-likelihood an image.
        reverse: The same with the partition function of reverse AIS; None where it is not estimated.
    """

    values: Tensor
    reverse: Tensor | None = None


Measure = Callable[[RBM], Scores]
"""Scores models, all replicas side by side."""

MakeMeasure = Callable[[Any, int], Measure]
"""Makes a measure from a data module and the number of replicas that are reported.

These are scored by test images, the others by held-out training images, so that nothing is chosen by test images.
"""


def negative_log_likelihood(data: Any, n_reported: int) -> Callable[[RBM, Tensor], Tensor]:
    """Negative log-likelihood of each replica, given its log Z; see :data:`MakeMeasure`.

    Raises:
        SettingError: Nothing is held out.
    """
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
