"""Early stopping: the weights of the pass that did best on held-out images."""

from typing import Any

import lightning.pytorch as pl
import torch

from memcomp_lightning.callbacks.base import required
from memcomp_lightning.errors import require_choice
from memcomp_lightning.training import JUDGED_BY, BestPass, Score


class BestWeights(pl.Callback):
    """Keeps the weights of the pass that is best on held-out images, and puts them back at the end.

    It goes by the ``score`` that ``validation_step`` returns. Each replica keeps its own best pass, so parameters
    must begin with the replica axes, which are those of the score. Of equal passes the first one stays.
    Checkpoints hold the weights kept so far.

    Args:
        by: What is better: a higher "accuracy", or a lower "loss".
        patience: Passes without a better one after which a replica is done, >= 1; training ends once all are. None
            trains to the end.
    """

    def __init__(self, *, by: str = "accuracy", patience: int | None = None) -> None:
        require_choice("finetune.best_by", by, tuple(JUDGED_BY))
        self.by, self.patience = by, patience
        self._best = BestPass(patience=patience)
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
        """Keep the weights of the replicas that are better than ever; ask to stop once none has patience left."""
        if self._score is None or trainer.sanity_checking:
            return
        # Every process must come to the same weights: they judge by the images of all.
        n_images = torch.tensor(float(self._score.n_images), device=pl_module.device)
        sums = self._score.loss, self._score.n_correct.float(), n_images
        loss, n_correct, n = (trainer.strategy.reduce(value, reduce_op="sum") for value in sums)
        self._best.offer(JUDGED_BY[self.by](Score(loss, n_correct, n)), pl_module.state_dict())  # type: ignore[arg-type]
        if self._best.over:
            trainer.should_stop = True

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put the best weights back."""
        if self._best.weights:
            pl_module.load_state_dict(self._best.weights)

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Put them back, too, if a resumed run had nothing left to train."""
        self.on_train_end(trainer, pl_module)

    def state_dict(self) -> dict[str, Any]:
        """What the best pass reached, how long none was better, and its weights."""
        return self._best.state_dict()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        self._best.load_state_dict(state_dict)
