"""MNIST in its own size."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.data import mnist_files
from memcomp_lightning.data.images import ImageData, PixelLayout
from memcomp_lightning.data.pixels import GreySource


@dataclass(frozen=True, kw_only=True, slots=True)
class Mnist(GreySource):
    """MNIST, 784 inputs: 60,000 training and 10,000 test images in 10 classes.

    Args:
        data_dir: Folder that holds ``MNIST/raw/``. None means the environment variable ``MEMCOMP_DATA_DIR``,
            or ``memcomp_lightning`` in the user's cache folder if that is not set.
        download: Whether missing files are fetched into that folder.
        pixels, threshold, seed: As for :class:`GreySource`.
    """

    name: ClassVar[str] = "mnist"
    layout: ClassVar[PixelLayout] = PixelLayout(height=28, width=28)

    data_dir: str | None = None
    download: bool = True

    def load_grey(self) -> ImageData:
        """Return the images in grey."""
        (train, train_label), (test, test_label) = mnist_files.read(self.data_dir, download=self.download)
        train_v, test_v = (self.inputs(images.to(torch.float32).div_(255)) for images in (train, test))
        return ImageData(train_v, train_label.long(), test_v, test_label.long(), 10, self.layout, self.name)

    @staticmethod
    def inputs(images: Float[Tensor, "n 28 28"]) -> Float[Tensor, "n n_visible"]:
        """What the visible units see of the images."""
        return images.flatten(1)
