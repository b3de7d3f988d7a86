"""Energies of the data against those of the negative phase, as distributions."""

import lightning.pytorch as pl
import numpy as np

from memcomp_lightning.callbacks.base import (
    EveryIterations,
    model_of,
    prefix_of,
    required,
    tensorboards,
    write_picture,
)
from memcomp_lightning.errors import require_count
from memcomp_lightning.objective import shares
from memcomp_lightning.plotting.histograms import plot_histograms
from memcomp_lightning.plotting.rendering import rendered


class EnergyHistograms(EveryIterations):
    """Draws how energies of images and of the negative phase are distributed: TensorBoard histograms, a picture.

    The histograms ``energies_data`` and ``energies_model`` have the same bins, and the picture ``energies`` shows
    them on top of each other: a well-trained model overlaps the data. Energies E(v, h) are those of the pass's
    last batch under the updated model, over all replicas; configurations of the negative phase count by their
    weights. Nothing is drawn where these are signed, as with the pseudo-likelihood.

    Args:
        every: Passes between two pictures, >= 1.
        n_bins: Bins from the lowest energy to the highest, >= 1.
    """

    def __init__(self, every: int = 10, n_bins: int = 40) -> None:
        super().__init__(every)
        require_count("n_bins", n_bins)
        self.n_bins = n_bins

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Histograms of the last batch of the pass."""
        boards = tensorboards(trainer)
        if not boards:
            return
        model = model_of(pl_module)
        step = required(outputs, self, "positive", "negative")
        energies, weights = {}, {}
        for name, configurations in (("data", step["positive"]), ("model", step["negative"])):
            share = shares(configurations).double().flatten().cpu()
            if bool((share < 0).any()):
                return
            energy = model.energy(configurations.v, configurations.h).double().flatten().cpu()
            energies[name] = energy[share > 0].numpy()
            weights[name] = share[share > 0].numpy() * configurations.v.shape[-2]
        everything = np.concatenate([*energies.values()])
        if not np.isfinite(everything).all():
            return
        edges = np.histogram_bin_edges(everything, self.n_bins)
        counts = {name: np.histogram(energies[name], edges, weights=weights[name])[0] for name in energies}
        for name, values in energies.items():
            for board in boards:
                board.add_histogram_raw(
                    f"{prefix_of(pl_module)}/energies_{name}",
                    # TensorBoard takes the outer edges from here.
                    min=edges[0],
                    max=edges[-1],
                    num=round(float(counts[name].sum())),
                    sum=float((weights[name] * values).sum()),
                    sum_squares=float((weights[name] * values**2).sum()),
                    bucket_limits=edges[1:].tolist(),
                    bucket_counts=counts[name].tolist(),
                    global_step=trainer.global_step,
                )
        figure = plot_histograms(edges, counts, xlabel="energy E(v, h)")
        write_picture(trainer, pl_module, "energies", rendered(figure))
