"""Schedules for modules of any kind."""

import lightning.pytorch as pl

from memcomp_lightning.callbacks.base import iteration_of
from memcomp_lightning.training import Schedule
from memcomp_lightning.training.schedules import begin_pass, check_schedules


class Schedules(pl.Callback):
    """Lets schedules change every optimiser of a module of yours at the start of each pass.

    The stages of this package take schedules themselves: ``EnergyPretraining(..., schedules=[...])``.

    Args:
        schedules: :class:`memcomp_lightning.training.MomentumSchedule` and others.
    """

    changes_training = True

    def __init__(self, *schedules: Schedule) -> None:
        self.schedules = schedules

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Raise a SettingError for an optimiser that a schedule cannot change."""
        check_schedules(self.schedules, trainer.optimizers)

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Set what this pass needs."""
        for optimizer in trainer.optimizers:
            begin_pass(self.schedules, optimizer, iteration_of(pl_module))
