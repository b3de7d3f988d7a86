"""How well one up-and-down pass brings the data back."""

import lightning.pytorch as pl
import torch

from memcomp_lightning.callbacks.base import EveryIterations, images_of_step, log_scalars, mask_of_step, model_of


class ReconstructionError(EveryIterations):
    """Logs ``reconstruction_error``, the mean of ``(v - E[v | E[h | v]])^2`` over entries and images.

    It is cheap and says that training runs; it is no measure of likelihood (Hinton 2010, section 5). The entries
    of a category are its states, 0 or 1 each. Missing values do not count; on the way up they have the means of
    units without couplings.
    """

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Reconstruct the last batch of the pass."""
        v, observed = images_of_step(outputs, self), mask_of_step(outputs)
        model = model_of(pl_module)
        if observed is not None:
            v = torch.where(observed, v, model.visible.mean(model.b.unsqueeze(-2)))
        error = (v - model.visible_mean(model.hidden_mean(v))).square()
        if observed is None:
            mean = error.mean((-1, -2))
        else:
            mean = (error * observed).sum((-1, -2)) / observed.sum((-1, -2))
        log_scalars(pl_module, {"reconstruction_error": mean})
