"""Sequence logos of the data and of samples of the model."""

from typing import Any, ClassVar

from matplotlib.figure import Figure
from torch import Tensor

from memcomp_lightning.callbacks.category_pictures import CategoryPictures
from memcomp_lightning.errors import require_count
from memcomp_lightning.plotting.logo import plot_logo


class Logos(CategoryPictures):
    """Draws letters as high as the information that they carry: picture ``logos``, of categorical visible units.

    One row for the data, one for samples; see :func:`memcomp_lightning.plotting.plot_logo`. Of units that are no
    categories there is no picture.

    Args:
        n_sites: Most sites to draw, the first ones, >= 1.
        settings: Of the base: ``every``, ``n_images``, ``n_samples``, ``n_sweeps``, ``alphabet``, ``seed``.
    """

    tag: ClassVar[str] = "logos"

    def __init__(self, *, n_sites: int = 64, **settings: Any) -> None:
        super().__init__(**settings)
        require_count("n_sites", n_sites)
        self.n_sites = n_sites

    def figure(self, data: Tensor, samples: Tensor, alphabet: str | None) -> Figure:
        """The logos."""
        tables = {"data": data[: self.n_sites].numpy(), "samples": samples[: self.n_sites].numpy()}
        return plot_logo(tables, alphabet=alphabet)
