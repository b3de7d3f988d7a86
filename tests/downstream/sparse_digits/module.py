"""An RBM with sparse hidden units, trained in a LightningModule of this project."""

from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.models import RBM
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import NegativePhaseSampler, positive_phase


class SparseRBM(pl.LightningModule):
    """Follow the contrast of both phases, and pull hidden means to a target (Lee, Ekanadham & Ng 2008).

    What its steps return, and ``model``, are what memcomp_lightning's callbacks look at.

    Args:
        n_visible: Number of inputs.
        n_hidden: Number of hidden units.
        sampler: Supplies the negative phase.
        lr: Learning rate.
        sparsity: Target of the mean of each hidden unit, in (0, 1).
        cost: Weight of the squared distance to it, >= 0.
        seed: Of weights and chains.
    """

    def __init__(
        self,
        n_visible: int,
        n_hidden: int,
        sampler: NegativePhaseSampler[RBM, Any],
        *,
        lr: float,
        sparsity: float,
        cost: float,
        seed: int,
    ) -> None:
        super().__init__()
        self.model = RBM(n_visible, n_hidden, generator=rng.stream(seed, "weights"))
        self.sampler = sampler
        self.lr, self.sparsity, self.cost = lr, sparsity, cost
        self._generator = rng.stream(seed, "negative_phase")
        self._state: Any = None

    def training_step(self, batch: list[Tensor], batch_idx: int) -> dict[str, Any]:
        """Loss of a batch of images, ``(n, n_visible)`` in [0, 1]."""
        (v,) = batch
        positive = positive_phase(self.model, v)
        if self._state is None:
            self._state = self.sampler.init(self.model, len(v), generator=self._generator)
        negative = self.sampler.sample(self.model, self._state, positive, generator=self._generator)
        self._state = negative.state
        gap = contrast(self.model, positive, negative.configurations)
        distance = (self.model.hidden_mean(v).mean(-2) - self.sparsity).square().sum()
        self.log("sparsity", positive.h.mean(), on_step=False, on_epoch=True)
        return {
            "loss": gap + self.cost * distance,
            "contrast": gap.detach(),
            "positive": positive,
            "negative": negative.configurations,
            "info": negative.info,
        }

    def validation_step(self, batch: list[Tensor], batch_idx: int) -> dict[str, Tensor]:
        """Held-out images, for the callbacks."""
        return {"v": batch[0]}

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Plain descent; the callback MomentumSchedule sets its momentum."""
        return torch.optim.SGD(self.model.parameters(), lr=self.lr, momentum=0.5)
