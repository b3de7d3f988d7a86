"""Free energy of training against held-out images: the overfitting monitor."""

import lightning.pytorch as pl
import torch
from torch import Tensor

from memcomp_lightning.callbacks.base import (
    LastImages,
    images_of_step,
    log_scalars,
    mask_of_step,
    model_of,
    required,
)


class FreeEnergyGap(pl.Callback):
    """Shows overfitting: logs ``free_energy_train``, ``free_energy_heldout`` and ``free_energy_gap``.

    The overfitting monitor of Hinton 2010, section 6. The unknown log Z cancels in ``mean F(held-out) - mean
    F(train) = mean log p(train) - mean log p(held-out)``: the gap is about zero at first, and one that grows is
    overfitting, by so many nats an image. Free energies alone say nothing, and gaps of different models (layers,
    seeds) cannot be compared in size. The same model judges the first ``n_images`` held-out images, the same in
    each pass, and about as many training images, from the last batches of the pass. Images with missing values
    have no free energy: of such data nothing is logged.

    Args:
        n_images: Images of each kind to judge, a replica, >= 1; training images come in whole batches, so there
            may be a few more.
    """

    def __init__(self, n_images: int = 500) -> None:
        self.n_images = n_images
        self._train = LastImages(n_images)
        self._heldout: list[tuple[Tensor, int]] = []

    def on_train_epoch_start(self, *_: object) -> None:
        """Forget the last pass."""
        self._train = LastImages(self.n_images)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Keep the visible states of the last batches, as many as asked for."""
        self._train.add(images_of_step(outputs, self), mask_of_step(outputs))

    def on_validation_epoch_start(self, *_: object) -> None:
        """Start a new mean."""
        self._heldout = []

    def on_validation_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Free energy of one chunk of held-out images, until there are enough."""
        missing = self.n_images - sum(n for _, n in self._heldout)
        if missing > 0 and mask_of_step(outputs) is None:
            v = required(outputs, self, "v")["v"][..., :missing, :]
            self._heldout.append((_free_energy(pl_module, v).sum(-1), v.shape[-2]))

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Judge the training images by the same model."""
        images = self._train.images()
        if images is None or not self._heldout or self._train.observed() is not None:
            return
        heldout = sum(total for total, _ in self._heldout) / sum(n for _, n in self._heldout)
        train = _free_energy(pl_module, images).mean(-1)
        values = {"free_energy_train": train, "free_energy_heldout": heldout, "free_energy_gap": heldout - train}
        log_scalars(pl_module, values)


@torch.no_grad()
def _free_energy(module: pl.LightningModule, v: Tensor) -> Tensor:
    return model_of(module).free_energy(v)
