"""MNIST in its own size and in the size of the paper."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from memcomp_lightning.data import mnist_files
from memcomp_lightning.data.images import ImageData, PixelLayout
from memcomp_lightning.data.pixels import GreySource
from memcomp_lightning.data.reduce import SIX_BY_SIX_WITHOUT_CORNERS, reduce_images


@dataclass(frozen=True, kw_only=True, slots=True)
class Mnist(GreySource):
    """MNIST, 784 inputs: 60,000 training and 10,000 test images in 10 classes.

    Args:
        data_dir: Folder that holds ``MNIST/raw/``. None means the environment variable ``MEMCOMP_DATA_DIR``,
            or ``memcomp_lightning`` in the user's cache folder if that is not set.
        download: Whether missing files are fetched into that folder.
        pixels, threshold, seed: As for :class:`GreySource`.
    """

    data_dir: str | None = None
    download: bool = True

    def load_grey(self) -> ImageData:
        """Return the images in grey."""
        arrays = mnist_files.read(self.data_dir, download=self.download)
        train_v, test_v = (_grey(images).flatten(1) for images in (arrays.train_images, arrays.test_images))
        return _image_data(arrays, train_v, test_v, PixelLayout(height=28, width=28), "mnist")


@dataclass(frozen=True, kw_only=True, slots=True)
class ReducedMnist(GreySource):
    """MNIST reduced to the paper's 32 inputs in [0, 1], see :func:`reduce_images`.

    Args:
        data_dir: As for :class:`Mnist`.
        download: As for :class:`Mnist`.
        pixels, threshold, seed: As for :class:`GreySource`, of the reduced images.
    """

    data_dir: str | None = None
    download: bool = True

    def load_grey(self) -> ImageData:
        """Return the images in grey."""
        arrays = mnist_files.read(self.data_dir, download=self.download)
        train_v, test_v = (reduce_images(_grey(images)) for images in (arrays.train_images, arrays.test_images))
        return _image_data(arrays, train_v, test_v, SIX_BY_SIX_WITHOUT_CORNERS, "reduced_mnist")


def _grey(images: UInt8[Tensor, "n 28 28"]) -> Float[Tensor, "n 28 28"]:
    return images.to(torch.float32).div_(255)


def _image_data(
    arrays: mnist_files.MnistArrays, train_v: Tensor, test_v: Tensor, layout: PixelLayout, name: str
) -> ImageData:
    return ImageData(
        train_v=train_v,
        train_label=arrays.train_labels.long(),
        test_v=test_v,
        test_label=arrays.test_labels.long(),
        n_classes=10,
        layout=layout,
        name=name,
    )
