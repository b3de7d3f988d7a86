"""Histograms of weights and biases."""

import lightning.pytorch as pl
from torch import nn

from memcomp_lightning.callbacks.base import EveryIterations, prefix_of, tensorboards


class ParameterHistograms(EveryIterations):
    """Writes a TensorBoard histogram of each parameter, over all replicas."""

    def __init__(self, every: int = 10) -> None:
        super().__init__(every)

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Parameters of the model in training, or of the whole module."""
        model: nn.Module = getattr(pl_module, "model", pl_module)
        for board in tensorboards(trainer):
            for name, parameter in model.named_parameters():
                if not parameter.numel():  # biases of no hidden units
                    continue
                board.add_histogram(f"{prefix_of(pl_module)}/{name}", parameter.flatten(), trainer.global_step)
