"""A grid of pictures of the inputs in TensorBoard: base of the callbacks that draw some."""

from abc import abstractmethod
from typing import TYPE_CHECKING

import lightning.pytorch as pl
from torch import Tensor

from memcomp_lightning.callbacks.base import EveryIterations, tensorboards, write_picture
from memcomp_lightning.errors import SettingError, require_count
from memcomp_lightning.plotting.grid import picture_grid
from memcomp_lightning.training.stages.base import unchanged

if TYPE_CHECKING:
    from memcomp_lightning.data import PixelLayout


class Pictures(EveryIterations):
    """Writes one picture grid of the first replica every so many passes.

    The data module's ``pixel_layout`` says by ``to_picture`` where each input lies; without one nothing is drawn.
    Its ``units``, if it has some, turn values into grey ones: spins, and the mean level of categories.

    Args:
        tag: Name of the picture, after stage and layer.
        every: Passes between two pictures, >= 1.
        n_pictures: Most tiles in the grid, >= 1.
    """

    def __init__(self, tag: str, every: int, n_pictures: int) -> None:
        super().__init__(every)
        require_count("n_pictures", n_pictures)
        self.tag = tag
        self.n_pictures = n_pictures

    @abstractmethod
    def tiles(self, pl_module: pl.LightningModule, outputs: object) -> Tensor:
        """Inputs to draw, ``(*replicas, n, n_visible)``, given the outputs of the pass's last step."""

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Draw the grid."""
        layout: PixelLayout | None = getattr(getattr(trainer, "datamodule", None), "pixel_layout", None)
        if layout is None or not tensorboards(trainer):
            return
        tiles, units = self.tiles(pl_module, outputs), getattr(trainer.datamodule, "units", None)  # type: ignore[attr-defined]
        if not tiles.numel():  # receptive fields of no hidden units
            return
        first_replica = tiles.reshape(-1, *tiles.shape[-2:])[0, : self.n_pictures]
        if units is not None:
            try:
                first_replica = units.to_intensity(first_replica)
            except SettingError as error:
                self.leave_out(str(error))
                return
        grid = picture_grid(layout.to_picture(first_replica).float().cpu().numpy())
        write_picture(trainer, pl_module, self.tag, grid)


def inputs_of(module: pl.LightningModule, v: Tensor) -> Tensor:
    """Inputs that visible states stand for."""
    images: Tensor = getattr(module, "images_of", unchanged)(v)
    return images
