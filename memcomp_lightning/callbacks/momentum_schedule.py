"""The paper's momentum: small for the first iterations, larger after."""

import lightning.pytorch as pl
from torch.optim import Optimizer

from memcomp_lightning.callbacks.base import iteration_of
from memcomp_lightning.errors import require, require_count


class MomentumSchedule(pl.Callback):
    """Sets the momentum of every optimiser at the start of each pass.

    ``initial`` for the first ``switch_at`` passes of a stage (in greedy pretraining, of a layer), ``final``
    after. Defaults are those of Manukian et al. 2019, section 4, and of Adachi & Henderson.

    Args:
        initial: Momentum of the first passes, in [0, 1).
        final: Momentum after, in [0, 1).
        switch_at: Number of passes with ``initial``, >= 0.
    """

    def __init__(self, initial: float = 0.1, final: float = 0.5, switch_at: int = 5) -> None:
        for name, value in (("initial", initial), ("final", final)):
            require(0 <= value < 1, f"momentum {name}", value, "a number in [0, 1)")
        require_count("switch_at", switch_at, minimum=0)
        self.initial = initial
        self.final = final
        self.switch_at = switch_at

    @staticmethod
    def check(optimizer: Optimizer) -> None:
        """Refuse an optimiser without momentum.

        Raises:
            SettingError: Naming the optimiser.
        """
        require(
            "momentum" in optimizer.param_groups[0],
            "optimizer",
            type(optimizer).__name__,
            "one with a 'momentum' setting (torch.optim.SGD, RMSprop) for MomentumSchedule",
            "Leave the schedule out: callbacks.pretrain.momentum_schedule=null, callbacks.finetune likewise.",
        )

    def momentum(self, iteration: int) -> float:
        """Momentum of a pass, by its number from 0 within the stage or layer."""
        return self.initial if iteration < self.switch_at else self.final

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Refuse optimisers without momentum."""
        for optimizer in trainer.optimizers:
            self.check(optimizer)

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Set the momentum of this pass."""
        momentum = self.momentum(iteration_of(pl_module))
        for optimizer in trainer.optimizers:
            for group in optimizer.param_groups:
                group["momentum"] = momentum
