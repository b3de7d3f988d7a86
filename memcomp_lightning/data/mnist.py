"""MNIST in its own size and in the size of the paper."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data import mnist_files
from memcomp_lightning.data.images import ImageData, PixelLayout
from memcomp_lightning.data.reduce import SIX_BY_SIX_WITHOUT_CORNERS, reduce_images
from memcomp_lightning.errors import require, require_choice, require_count

Pixels = Literal["grey", "threshold", "stochastic"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Mnist:
    """MNIST, 784 inputs: 60,000 training and 10,000 test images in 10 classes.

    Args:
        data_dir: Folder that holds ``MNIST/raw/``. None means the environment variable ``MEMCOMP_DATA_DIR``,
            or ``memcomp_lightning`` in the user's cache folder if that is not set.
        pixels: What the inputs are. ``grey``: intensities in [0, 1]. ``threshold``: 1 where the intensity is
            above ``threshold``, else 0. ``stochastic``: 1 with the intensity as probability, drawn once.
        threshold: Used by ``threshold`` alone, in [0, 1).
        seed: Of the draw, used by ``stochastic`` alone. It belongs to the data: keep it when the seed of
            the training varies.
        download: Whether missing files are fetched into that folder.
    """

    data_dir: str | None = None
    pixels: Pixels = "grey"
    threshold: float = 0.5
    seed: int = 0
    download: bool = True

    def __post_init__(self) -> None:
        require_choice("pixels", self.pixels, ("grey", "threshold", "stochastic"))
        require(0 <= self.threshold < 1, "threshold", self.threshold, "a number in [0, 1)")
        require_count("seed", self.seed, minimum=0)

    def load(self) -> ImageData:
        """Return the images.

        Raises:
            FileNotFoundError: A file is missing and could not be fetched.
            CorruptFileError: A file does not hold what it must.
        """
        arrays = mnist_files.read(self.data_dir, download=self.download)
        train_v, test_v = _grey(arrays.train_images).flatten(1), _grey(arrays.test_images).flatten(1)
        if self.pixels == "threshold":
            train_v, test_v = ((v > self.threshold).float() for v in (train_v, test_v))
        if self.pixels == "stochastic":
            generator = rng.stream(self.seed, "binarisation")
            train_v, test_v = (rng.bernoulli(v, generator=generator) for v in (train_v, test_v))
        name = "mnist" if self.pixels == "grey" else f"mnist_{self.pixels}"
        return _image_data(arrays, train_v, test_v, PixelLayout(height=28, width=28), name)


@dataclass(frozen=True, kw_only=True, slots=True)
class ReducedMnist:
    """MNIST reduced to the paper's 32 inputs in [0, 1], see :func:`reduce_images`.

    Args:
        data_dir: As for :class:`Mnist`.
        download: As for :class:`Mnist`.
    """

    data_dir: str | None = None
    download: bool = True

    def load(self) -> ImageData:
        """Return the images.

        Raises:
            FileNotFoundError: A file is missing and could not be fetched.
            CorruptFileError: A file does not hold what it must.
        """
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
