"""How often the states of categories are in the data and in samples of the model."""

from matplotlib.figure import Figure
from torch import Tensor

from memcomp_lightning.callbacks.against_samples import AgainstSamples, frequencies, has_categories, letters_in
from memcomp_lightning.data.schema import Schema
from memcomp_lightning.models.units import Units
from memcomp_lightning.plotting.state_frequencies import plot_state_frequencies


class StateFrequencies(AgainstSamples):
    """Draws the frequency of each state at each site: picture ``state_frequencies``, of categorical visible units.

    Three heat maps show data, samples and their difference. Of mixed visible units the categories are drawn; of
    others there is no picture.

    Args:
        every: Passes between two pictures, >= 1.
        n_images: Training images to take, >= 1.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        alphabet: Letters of the states; None takes those of sequences, and else digits and then capitals.
        seed: Seed of the chains.
    """

    def __init__(
        self,
        every: int = 20,
        n_images: int = 1000,
        n_samples: int = 200,
        n_sweeps: int = 100,
        alphabet: str | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__("state_frequencies", every, n_images, n_samples, n_sweeps, seed)
        self.alphabet = alphabet

    def has_units(self, units: Units) -> bool:
        """Whether some are categories."""
        return has_categories(units)

    def figure(
        self, units: Units, data: Tensor, observed: Tensor | None, samples: Tensor, schema: Schema | None
    ) -> Figure:
        """The heat maps."""
        tables = [frequencies(units, data, observed).numpy(), frequencies(units, samples).numpy()]
        return plot_state_frequencies(*tables, alphabet=self.alphabet or letters_in(schema))
