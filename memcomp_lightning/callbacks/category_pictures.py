"""What the pictures have in common that show how often the states of categories are."""

from abc import abstractmethod
from typing import ClassVar

from matplotlib.figure import Figure
from torch import Tensor

from memcomp_lightning.callbacks.against_samples import (
    AgainstSamples,
    Seen,
    frequencies,
    has_categories,
    letters_in,
)
from memcomp_lightning.models.units import Units


class CategoryPictures(AgainstSamples):
    """A picture of the frequencies of states, in data and in samples, of categorical visible units.

    Of mixed visible units the categories are drawn; of others there is no picture.

    Attributes:
        tag: Name of the picture, after stage and layer.

    Args:
        every: Passes between two pictures, >= 1.
        n_images: Training images to take, >= 1.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        alphabet: Letters of the states; None takes those of sequences, and else digits and then capitals.
        seed: Seed of the chains.
    """

    tag: ClassVar[str]

    def __init__(
        self,
        every: int = 20,
        n_images: int = 1000,
        n_samples: int = 200,
        n_sweeps: int = 100,
        alphabet: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(every, n_images, n_samples, n_sweeps, seed)
        self.alphabet = alphabet

    @abstractmethod
    def figure(self, data: Tensor, samples: Tensor, alphabet: str | None) -> Figure:
        """Draw frequencies of data and of samples, ``(n_sites, q)`` each; NaN where a site has fewer states."""

    def has_units(self, units: Units) -> bool:
        """Whether some are categories."""
        return has_categories(units)

    def figures(self, seen: Seen) -> dict[str, Figure]:
        """The picture."""
        data, samples = (
            frequencies(rows.units, rows.v, rows.observed, rows.weight) for rows in (seen.data, seen.samples)
        )
        return {self.tag: self.figure(data, samples, self.alphabet or letters_in(seen.data.schema))}
