"""Sequence logos of the data and of samples of the model."""

from matplotlib.figure import Figure
from torch import Tensor

from memcomp_lightning.callbacks.against_samples import AgainstSamples, frequencies, has_categories, letters_in
from memcomp_lightning.data.schema import Schema
from memcomp_lightning.errors import require_count
from memcomp_lightning.models.units import Units
from memcomp_lightning.plotting.logo import plot_logo


class Logos(AgainstSamples):
    """Draws letters as high as the information that they carry: picture ``logos``, of categorical visible units.

    One row for the data, one for samples; see :func:`memcomp_lightning.plotting.plot_logo`. Of units that are no
    categories there is no picture.

    Args:
        every: Passes between two pictures, >= 1.
        n_images: Training images to take, >= 1.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        n_sites: Most sites to draw, the first ones, >= 1.
        alphabet: Letters of the states; None takes those of sequences, and else digits and then capitals.
        seed: Seed of the chains.
    """

    def __init__(
        self,
        every: int = 20,
        n_images: int = 1000,
        n_samples: int = 200,
        n_sweeps: int = 100,
        n_sites: int = 64,
        alphabet: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__("logos", every, n_images, n_samples, n_sweeps, seed)
        require_count("n_sites", n_sites)
        self.n_sites = n_sites
        self.alphabet = alphabet

    def has_units(self, units: Units) -> bool:
        """Whether some are categories."""
        return has_categories(units)

    def figure(
        self, units: Units, data: Tensor, observed: Tensor | None, samples: Tensor, schema: Schema | None
    ) -> Figure:
        """The logos."""
        found = {"data": frequencies(units, data, observed), "samples": frequencies(units, samples)}
        tables = {name: table[: self.n_sites].numpy() for name, table in found.items()}
        return plot_logo(tables, alphabet=self.alphabet or letters_in(schema))
