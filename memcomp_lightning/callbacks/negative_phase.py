"""Energies of the negative phase and what its sampler reports."""

from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl

from memcomp_lightning.callbacks.base import (
    EveryIterations,
    log_scalars,
    prefix_of,
    rbm_of,
    required,
    tensorboards,
)


class NegativePhaseEnergies(EveryIterations):
    """Logs energies of both phases, their contrast, the sampler's diagnostics, and an energy histogram.

    ``contrast`` is the loss of the pass's last update, before its step, and ``negative_phase/<key>`` are the
    sampler's diagnostics then. ``energy_data``, ``energy_model`` and ``energy_model_lowest``, and the histograms
    ``energies_data`` and ``energies_model`` in TensorBoard, are energies of the same states under the updated
    model.

    Args:
        every: Passes between two values, >= 1.
    """

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Mapping[str, Any]) -> None:
        """Energies of the last batch of the pass."""
        rbm = rbm_of(pl_module)
        positive, negative = required(outputs, "positive", self), required(outputs, "negative", self)
        energies = rbm.energy(negative.v, negative.h)
        data_energies = rbm.energy(positive.v, positive.h)
        log_scalars(
            pl_module,
            {
                "energy_data": data_energies.mean(-1),
                "energy_model": rbm.mean_energy(negative),
                "energy_model_lowest": energies.min(-1).values,
                "contrast": required(outputs, "contrast", self),
                **{f"negative_phase/{key}": value for key, value in outputs.get("info", {}).items()},
            },
        )
        for board in tensorboards(trainer):
            for name, values in (("energies_data", data_energies), ("energies_model", energies)):
                board.add_histogram(f"{prefix_of(pl_module)}/{name}", values.flatten(), trainer.global_step)
