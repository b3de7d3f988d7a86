"""Says that fine-tuning ended too early: few labels make few updates a pass."""

import logging
from typing import Any

import lightning.pytorch as pl

from memcomp_lightning.callbacks.base import required
from memcomp_lightning.training import Score

log = logging.getLogger(__name__)

FALL = 0.95
"""Mean loss of the last tenth of the passes over that of the tenth before: below it training has not settled."""

FITTED = 0.99
"""Share of the training rows from which more passes are not asked for."""


class StillFalling(pl.Callback):
    """Logs a line where the loss on the training rows still fell in the last passes, and rows are still wrong.

    It looks at the ``score`` that ``training_step`` returns, and only at training of ten passes or more that went
    on to its last one. Checkpoints hold the losses so far.
    """

    def __init__(self) -> None:
        self._losses: list[float] = []
        self._score: Score | None = None

    def on_train_epoch_start(self, *_: object) -> None:
        """Start a new sum."""
        self._score = None

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Add a batch."""
        score = required(outputs, self, "score")["score"]
        self._score = score if self._score is None else self._score + score

    def on_train_epoch_end(self, *_: object) -> None:
        """Keep the mean loss of the pass, over all replicas."""
        if self._score is not None:
            self._losses.append(float(self._score.mean_loss.mean()))

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Say it."""
        n = len(self._losses)
        tenth = n // 10
        if not tenth or n < (trainer.max_epochs or 0) or self._score is None or not trainer.is_global_zero:
            return
        last, before = (sum(part) / tenth for part in (self._losses[-tenth:], self._losses[-2 * tenth : -tenth]))
        if last < FALL * before and float(self._score.accuracy.mean()) < FITTED:
            log.info(
                "Fine-tuning has not settled: its loss still fell, from %.3g to %.3g in the last passes. Few "
                "labels make few updates a pass: type finetune.iterations=%d, say.",
                *(before, last, 10 * n),
            )

    def state_dict(self) -> dict[str, Any]:
        """The losses of all passes so far."""
        return {"losses": list(self._losses)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self._losses = list(state_dict["losses"])
