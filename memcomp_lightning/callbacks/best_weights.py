"""Early stopping in hindsight: the weights of the pass that did best on held-out images."""

from typing import Any

import lightning.pytorch as pl
import torch

from memcomp_lightning.callbacks.base import required
from memcomp_lightning.training import BestPass, Score


class BestWeights(pl.Callback):
    """Keeps the weights of the pass with the highest accuracy on held-out images, and puts them back at the end.

    It goes by the ``score`` that ``validation_step`` returns. Each replica keeps its own best pass, so parameters
    must begin with the replica axes, which are those of the accuracy. Of equal passes the first one stays.
    Checkpoints hold the weights kept so far.
    """

    def __init__(self) -> None:
        self._best = BestPass()
        self._score: Score | None = None

    def on_validation_epoch_start(self, *_: object) -> None:
        """Start a new sum."""
        self._score = None

    def on_validation_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Add a batch."""
        score = required(outputs, self, "score")["score"]
        self._score = score if self._score is None else self._score + score

    @torch.no_grad()
    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep the weights of the replicas that are better than ever."""
        if self._score is None or trainer.sanity_checking:
            return
        # Every process must come to the same weights: they judge by the images of all.
        counts = self._score.n_correct.float(), torch.tensor(float(self._score.n_images), device=pl_module.device)
        n_correct, n_images = (trainer.strategy.reduce(count, reduce_op="sum") for count in counts)
        self._best.offer(n_correct / n_images, pl_module.state_dict())

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put the best weights back."""
        if self._best.weights:
            pl_module.load_state_dict(self._best.weights)

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put them back, too, if a resumed run had nothing left to train."""
        self.on_train_end(trainer, pl_module)

    def state_dict(self) -> dict[str, Any]:
        """Accuracies and weights."""
        return {"accuracy": self._best.accuracy, "weights": self._best.weights}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self._best.accuracy, self._best.weights = state_dict["accuracy"], state_dict["weights"]
