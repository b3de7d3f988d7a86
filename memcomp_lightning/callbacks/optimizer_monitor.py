"""Learning rate and momentum."""

import lightning.pytorch as pl

from memcomp_lightning.callbacks.base import log_scalars


class OptimizerMonitor(pl.Callback):
    """Logs ``learning_rate`` and, where there is one, ``momentum`` of the optimiser that steps.

    Lightning's LearningRateMonitor names its tags by optimiser; here they carry stage and layer.
    """

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log the settings that this pass was done with."""
        optimizer = getattr(pl_module, "active_optimizer", trainer.optimizers[0])
        group = optimizer.param_groups[0]
        values = {"learning_rate": group["lr"]}
        if "momentum" in group:
            values["momentum"] = group["momentum"]
        log_scalars(pl_module, values)
