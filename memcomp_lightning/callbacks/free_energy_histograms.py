"""Free energies of training images, of samples and of held-out images, as distributions."""

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning import rng
from memcomp_lightning.callbacks.against_samples import AgainstSamples, Seen
from memcomp_lightning.callbacks.base import ShownModel
from memcomp_lightning.data.shown import Shown
from memcomp_lightning.errors import require_count
from memcomp_lightning.plotting.likelihoods import plot_likelihoods


class FreeEnergyHistograms(AgainstSamples):
    """Draws how likely images and samples are under the model: picture ``free_energies``, of minus free energies.

    The unknown log Z would shift all of them alike: ``-F(v) = log p(v) + log Z``. A model that is right gives its
    samples what it gives held-out images; see :func:`memcomp_lightning.plotting.plot_likelihoods`. Data that are
    means in between, as grey values are, are drawn. Images with a missing value have no free energy and are left
    out. Of a Boltzmann machine whose hidden units are coupled it is the mean-field bound.

    Args:
        every: Passes between two pictures, >= 1.
        n_images: Training images, and held-out ones, to take, >= 1.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        n_bins: Bins, >= 1.
        seed: Seed of the chains and the draws.
    """

    def __init__(
        self,
        every: int = 20,
        n_images: int = 1000,
        n_samples: int = 500,
        n_sweeps: int = 100,
        n_bins: int = 40,
        seed: int = 0,
    ) -> None:
        super().__init__(every, n_images, n_samples, n_sweeps, seed)
        require_count("n_bins", n_bins)
        self.n_bins = n_bins

    def figures(self, seen: Seen) -> dict[str, Figure]:
        """The histograms; none where no training image is complete."""
        generator = rng.stream(self.seed, "evaluation", 1)
        sets = {"data": seen.data.complete, "samples": seen.samples}
        if seen.heldout is not None:
            sets["held-out data"] = seen.heldout.complete
        if not len(sets["data"].v):
            self.leave_out("images with missing values have no free energy, and none is complete")
            return {}
        sets = {name: rows.drawn(generator) for name, rows in sets.items() if len(rows.v)}
        values = {name: _minus_free_energy(seen.model, rows) for name, rows in sets.items()}
        weights = {name: rows.weights for name, rows in sets.items() if rows.weights is not None}
        xlabel = "minus free energy (nats)"
        return {"free_energies": plot_likelihoods(values, weights=weights, xlabel=xlabel, n_bins=self.n_bins)}


def _minus_free_energy(model: ShownModel, rows: Shown) -> NDArray[np.float64]:
    """Under the first replica, ``(n,)``."""
    v = rows.v.to(model.b).expand(*model.replicas, -1, -1)
    found: NDArray[np.float64] = -model.free_energy(v).reshape(-1, len(rows.v))[0].double().cpu().numpy()
    return found
