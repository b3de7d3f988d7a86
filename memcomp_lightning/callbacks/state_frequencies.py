"""How often the states of categories are in the data and in samples of the model."""

from typing import ClassVar

from matplotlib.figure import Figure
from torch import Tensor

from memcomp_lightning.callbacks.category_pictures import CategoryPictures
from memcomp_lightning.plotting.state_frequencies import plot_state_frequencies


class StateFrequencies(CategoryPictures):
    """Draws the frequency of each state at each site: picture ``state_frequencies``, of categorical visible units.

    Three heat maps show data, samples and their difference. Of mixed visible units the categories are drawn; of
    others there is no picture. The settings are those of
    :class:`memcomp_lightning.callbacks.category_pictures.CategoryPictures`.
    """

    tag: ClassVar[str] = "state_frequencies"

    def figure(self, data: Tensor, samples: Tensor, alphabet: str | None) -> Figure:
        """The heat maps."""
        return plot_state_frequencies(data.numpy(), samples.numpy(), alphabet=alphabet)
