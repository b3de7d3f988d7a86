"""Likelihoods as torchmetrics: sums over batches and processes, one value for each replica."""

from typing import Any

import torch
from torch import Tensor
from torchmetrics import Metric

from memcomp_lightning.likelihood import log_likelihood, log_pseudo_likelihood
from memcomp_lightning.models import EnergyModel


class _MeanOverImages(Metric):
    """Sum and number of values, ``(*replicas,)`` each."""

    full_state_update = False
    higher_is_better = True
    is_differentiable = False

    total: Tensor
    n_images: Tensor

    def __init__(self, replicas: tuple[int, ...] = (), **settings: Any) -> None:
        super().__init__(**settings)
        self.add_state("total", torch.zeros(replicas, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("n_images", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def _add(self, values: Tensor) -> None:
        self.total += values.detach().double().sum(-1)
        self.n_images += values.shape[-1]

    def compute(self) -> Tensor:
        """Nats an image, ``(*replicas,)`` float64; NaN before the first image."""
        return self.total / self.n_images


class MeanLogLikelihood(_MeanOverImages):
    """Mean of ``log p(v)`` over images, nats: ``update(model, v, log_z)``.

    ``replicas`` are the leading axes of the model.
    """

    @torch.no_grad()
    def update(self, model: EnergyModel, v: Tensor, log_z: Tensor) -> None:
        """Add images in {0, 1}, ``(*replicas, n, n_visible)``; ``log_z`` is the model's, ``(*replicas,)``."""
        self._add(log_likelihood(model, v, log_z))


class MeanLogPseudoLikelihood(_MeanOverImages):
    """Mean over images of ``sum_j log p(v_j | all other v)``, nats: ``update(model, v)``. It needs no log Z.

    ``replicas`` are the leading axes of the model.
    """

    @torch.no_grad()
    def update(self, model: EnergyModel, v: Tensor) -> None:
        """Add images in {0, 1}, ``(*replicas, n, n_visible)``."""
        self._add(log_pseudo_likelihood(model, v).sum(-1))
