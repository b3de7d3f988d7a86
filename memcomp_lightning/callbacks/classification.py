"""Loss and accuracy of supervised training."""

import lightning.pytorch as pl

from memcomp_lightning.callbacks.base import log_scalars, required
from memcomp_lightning.training import Score


class ClassificationMetrics(pl.Callback):
    """Logs loss and accuracy of a classifier, on training, held-out and test images: means over replicas.

    The names are ``loss``, ``accuracy``, ``heldout_loss``, ``heldout_accuracy``, ``test_loss``, ``test_accuracy``.

    Attributes:
        latest: The newest score of each kind, "train", "heldout" and "test", with the values of each replica.
    """

    def __init__(self) -> None:
        self.latest: dict[str, Score] = {}

    def _add(self, kind: str, outputs: object) -> None:
        score = required(outputs, self, "score")["score"]
        self.latest[kind] = self.latest[kind] + score if kind in self.latest else score

    def _log(self, kind: str, pl_module: pl.LightningModule) -> None:
        if kind in self.latest:
            score, tag = self.latest[kind], "" if kind == "train" else f"{kind}_"
            log_scalars(pl_module, {f"{tag}loss": score.mean_loss, f"{tag}accuracy": score.accuracy})

    def on_train_epoch_start(self, *_: object) -> None:
        """Start a new sum."""
        self.latest.pop("train", None)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Add a batch."""
        self._add("train", outputs)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log the pass; the network changed while it was summed up."""
        self._log("train", pl_module)

    def on_validation_epoch_start(self, *_: object) -> None:
        """Start a new sum."""
        self.latest.pop("heldout", None)

    def on_validation_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Add a batch."""
        self._add("heldout", outputs)

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log the held-out images."""
        self._log("heldout", pl_module)

    def on_test_epoch_start(self, *_: object) -> None:
        """Start a new sum."""
        self.latest.pop("test", None)

    def on_test_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Add a batch."""
        self._add("test", outputs)

    def on_test_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log the test images."""
        self._log("test", pl_module)
