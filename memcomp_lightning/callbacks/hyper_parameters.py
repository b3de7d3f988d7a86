"""Settings beside final metrics: TensorBoard's HParams tab compares a sweep."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import lightning.pytorch as pl
from lightning.pytorch.loggers import Logger, TensorBoardLogger


def write_hyper_parameters(
    loggers: Iterable[Logger], settings: Mapping[str, Any], metrics: Mapping[str, float]
) -> None:
    """Hand settings and final metrics to the loggers; those other than TensorBoard get them apart.

    Args:
        loggers: Lightning loggers.
        settings: Nested settings, plain values; become ``group/name`` in the HParams tab.
        metrics: Final metrics by tag.
    """
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(dict(settings), dict(metrics))
        else:
            logger.log_hyperparams(dict(settings))
            logger.log_metrics(dict(metrics))
        logger.save()


class HyperParameters(pl.Callback):
    """Hands settings and final metrics to the loggers at the end of training.

    Args:
        settings: Nested settings, plain values.
        metrics: Names of metrics to show beside them as ``final/<name>``, if they were logged.
    """

    def __init__(self, settings: Mapping[str, Any], metrics: Sequence[str]) -> None:
        self.settings = dict(settings)
        self.metrics = tuple(metrics)

    def on_fit_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Log both."""
        if trainer.is_global_zero:
            logged = trainer.callback_metrics
            final = {f"final/{name}": float(logged[name]) for name in self.metrics if name in logged}
            write_hyper_parameters(trainer.loggers, self.settings, final)
