"""How well one up-and-down pass brings the data back."""

import lightning.pytorch as pl

from memcomp_lightning.callbacks.base import EveryIterations, images_of_step, log_scalars, model_of


class ReconstructionError(EveryIterations):
    """Logs ``reconstruction_error``, the mean of ``(v - E[v | E[h | v]])^2`` over units and images.

    It is cheap and says that training runs; it is no measure of likelihood (Hinton 2010, section 5).
    """

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Reconstruct the last batch of the pass."""
        v = images_of_step(outputs, self)
        model = model_of(pl_module)
        error = (v - model.visible_mean(model.hidden_mean(v))).square().mean((-1, -2))
        log_scalars(pl_module, {"reconstruction_error": error})
