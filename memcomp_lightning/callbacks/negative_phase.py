"""Energies of the two phases."""

import lightning.pytorch as pl

from memcomp_lightning.callbacks.base import EveryIterations, log_scalars, model_of, required


class NegativePhaseEnergies(EveryIterations):
    """Logs energies of both phases and their contrast.

    ``contrast`` is the loss of the pass's last update, before its step. ``energy_data``, ``energy_model`` and
    ``energy_model_lowest`` are energies of the same states under the updated model. :class:`EnergyHistograms`
    draws how they are distributed; :class:`SamplerDiagnostics` logs what the sampler reports.
    """

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Energies of the last batch of the pass."""
        model = model_of(pl_module)
        step = required(outputs, self, "positive", "negative", "contrast")
        positive, negative = step["positive"], step["negative"]
        values = {
            "energy_data": model.energy(positive.v, positive.h).mean(-1),
            "energy_model": model.mean_energy(negative),
            "energy_model_lowest": model.energy(negative.v, negative.h).min(-1).values,
            "contrast": step["contrast"],
        }
        log_scalars(pl_module, values)
