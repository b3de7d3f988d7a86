"""How values of real units are distributed in the data and in samples of the model."""

import torch
from matplotlib.figure import Figure

from memcomp_lightning.callbacks.against_samples import AgainstSamples, Seen, kinds_in
from memcomp_lightning.errors import require_count
from memcomp_lightning.models.units import Units
from memcomp_lightning.plotting.densities import plot_densities


class Densities(AgainstSamples):
    """Draws histograms of data and samples for a few real visible units: picture ``densities``.

    The units are those that vary most in the data. Of visible units none of which is real there is no picture.

    Args:
        every: Passes between two pictures, >= 1.
        n_images: Training images to take, >= 1.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        n_units: Most units to draw, >= 1.
        seed: Seed of the chains.
    """

    def __init__(
        self,
        every: int = 20,
        n_images: int = 1000,
        n_samples: int = 500,
        n_sweeps: int = 100,
        n_units: int = 6,
        seed: int = 0,
    ) -> None:
        super().__init__(every, n_images, n_samples, n_sweeps, seed)
        require_count("n_units", n_units)
        self.n_units = n_units

    def has_units(self, units: Units) -> bool:
        """Whether some are real."""
        return units.real

    def figures(self, seen: Seen) -> dict[str, Figure]:
        """The histograms."""
        data, samples = seen.data, seen.samples
        real = torch.cat([torch.arange(at.start, at.stop) for kind, at in kinds_in(data.units) if kind.real])
        known = torch.from_numpy(data.entries)[:, real]
        variance = (known - known.nanmean(0)).square().nanmean(0).nan_to_num(nan=0.0)
        chosen = torch.topk(variance, min(self.n_units, len(real))).indices.sort().values
        names = [data.entry_names[unit] for unit in real[chosen].tolist()]
        drawn = samples.entries[:, real[chosen].numpy()]
        return {"densities": plot_densities(known[:, chosen].numpy(), drawn, names)}
