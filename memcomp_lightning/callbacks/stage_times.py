"""Where the seconds of a stage go."""

import time
from typing import Any

import lightning.pytorch as pl

from memcomp_lightning.callbacks.base import prefix_of, tensorboards

PARTS = ("training_s", "validation_s", "other_s")


class StageTimes(pl.Callback):
    """Measures the seconds of training steps, validation steps and everything else, by stage and layer.

    ``other_s`` is what lies between the steps: other callbacks, loading of batches, logging, checkpoints. A step
    is the time between this callback's hooks before and after it: put it first in the list, so that the hooks of
    the others fall outside. On a GPU work counts where the program waits for it.

    At the end of training the scalars ``<stage>/seconds/<part>`` go to all loggers, and the text
    ``<stage>/seconds``, a table of all layers, to TensorBoard. A resumed run adds to what the checkpoint holds.

    Attributes:
        summary: Seconds by prefix of stage and layer, and part: ``training_s``, ``validation_s``, ``other_s``.
    """

    def __init__(self) -> None:
        self.summary: dict[str, dict[str, float]] = {}
        self._stage = ""
        self._mark: float | None = None

    def _add(self, part: str) -> None:
        """Count the time since the last mark."""
        now = time.perf_counter()
        if self._mark is not None:
            self.summary.setdefault(self._stage, dict.fromkeys(PARTS, 0.0))[part] += now - self._mark
            self._mark = now

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Start the clock."""
        self._stage, self._mark = prefix_of(pl_module), time.perf_counter()

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """What came after the last pass, checkpoints above all, belongs to that pass's layer."""
        self._add("other_s")
        self._stage = prefix_of(pl_module)

    def on_train_batch_start(self, *_: object) -> None:
        """A training step begins."""
        self._add("other_s")

    def on_train_batch_end(self, *_: object) -> None:
        """A training step is done."""
        self._add("training_s")

    def on_validation_batch_start(self, *_: object) -> None:
        """A validation step begins."""
        self._add("other_s")

    def on_validation_batch_end(self, *_: object) -> None:
        """A validation step is done."""
        self._add("validation_s")

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Stop the clock, and log."""
        self._add("other_s")
        self._mark = None
        seconds = {f"{stage}/seconds/{part}": s for stage, row in self.summary.items() for part, s in row.items()}
        for logger in trainer.loggers:
            logger.log_metrics(seconds, step=trainer.global_step)
            logger.save()
        for board in tensorboards(trainer):
            board.add_text(f"{self._stage.partition('/')[0]}/seconds", self._table(), trainer.global_step)

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Stop the clock."""
        self._add("other_s")
        self._mark = None

    def _table(self) -> str:
        lines = [
            "| stage | training steps, s | validation steps, s | everything else, s | all, s |",
            "| --- | --- | --- | --- | --- |",
        ]
        for stage, row in self.summary.items():
            numbers = [*(row[part] for part in PARTS), sum(row.values())]
            lines.append(f"| {stage} | " + " | ".join(f"{seconds:.2f}" for seconds in numbers) + " |")
        return "\n".join(lines)

    def state_dict(self) -> dict[str, Any]:
        """Seconds until now."""
        self._add("other_s")
        return {"summary": {stage: dict(row) for stage, row in self.summary.items()}}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self.summary = {stage: dict(row) for stage, row in state_dict["summary"].items()}
