"""A learning rate that falls linearly."""

import lightning.pytorch as pl
from torch.optim import Optimizer

from memcomp_lightning.callbacks.base import iteration_of
from memcomp_lightning.errors import require, require_count


class LearningRateDecay(pl.Callback):
    """Lets the learning rate of every optimiser fall linearly, pass by pass, from its own value to a share of it.

    In greedy pretraining each layer starts afresh.

    Args:
        n_passes: Passes until the last one, >= 1; later ones keep the lowest rate.
        final: Share of the initial rate in the last pass, in (0, 1].
    """

    def __init__(self, n_passes: int, final: float = 0.01) -> None:
        require_count("n_passes", n_passes)
        require(0 < final <= 1, "final", final, "a number in (0, 1]")
        self.n_passes = n_passes
        self.final = final

    def factor(self, iteration: int) -> float:
        """Share of the initial rate in a pass, by its number from 0 within the stage or layer.

        >>> [LearningRateDecay(3, final=0.5).factor(iteration) for iteration in range(4)]
        [1.0, 0.75, 0.5, 0.5]
        """
        done = min(iteration / max(self.n_passes - 1, 1), 1.0)
        return 1.0 - (1.0 - self.final) * done

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Set the learning rate of this pass."""
        for optimizer in trainer.optimizers:
            set_learning_rate(optimizer, self.factor(iteration_of(pl_module)))


def set_learning_rate(optimizer: Optimizer, factor: float) -> None:
    """Give every group a share of its first learning rate, which checkpoints of the optimiser keep."""
    for group in optimizer.param_groups:
        group["lr"] = group.setdefault("initial_lr", group["lr"]) * factor
