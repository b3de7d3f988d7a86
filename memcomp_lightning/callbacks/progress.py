"""A progress bar that says where training is."""

import sys

import lightning.pytorch as pl
from lightning.pytorch.callbacks import ProgressBar
from tqdm.auto import tqdm

from memcomp_lightning.callbacks.base import prefix_of


class StageProgressBar(ProgressBar):
    """One line a stage: stage, layer and iteration, passes done, time left, the newest scalars.

    Written to standard error, by the process of rank 0.

    Args:
        metrics: Endings of logged names to show, in this order.
    """

    def __init__(
        self,
        metrics: tuple[str, ...] = (
            "reconstruction_error",
            "contrast",
            "log_likelihood_heldout",
            "loss",
            "heldout_accuracy",
        ),
    ) -> None:
        super().__init__()
        self.metrics = tuple(metrics)
        self._bar = tqdm(disable=True)
        self._enabled = True

    def disable(self) -> None:
        """Lightning's switch for processes other than rank 0."""
        self._enabled = False

    def enable(self) -> None:
        """Inverse of :meth:`disable`."""
        self._enabled = True

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Open the bar."""
        total = None if trainer.max_epochs in (None, -1) else trainer.max_epochs
        self._bar = tqdm(
            total=total,
            initial=trainer.current_epoch,
            unit="pass",
            file=sys.stderr,
            dynamic_ncols=True,
            disable=None if self._enabled else True,
        )
        self._describe(pl_module)

    def on_train_epoch_start(self, trainer: pl.Trainer, *_: object) -> None:
        """Say where training is."""
        self._describe(trainer.lightning_module)

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Advance by one pass."""
        prefix = prefix_of(pl_module)
        logged = trainer.callback_metrics
        shown = {
            name: f"{float(logged[f'{prefix}/{name}']):.4g}"
            for name in self.metrics
            if f"{prefix}/{name}" in logged
        }
        self._bar.set_postfix(shown, refresh=False)
        self._bar.update(1)

    def _describe(self, pl_module: pl.LightningModule) -> None:
        self._bar.set_description(str(getattr(pl_module, "progress", prefix_of(pl_module))), refresh=False)

    def on_train_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Close the bar."""
        self._bar.close()

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Close the bar."""
        self._bar.close()
