"""What a source of images hands over, checked once, before any training."""

from dataclasses import dataclass
from typing import Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.data.missing import split_missing
from memcomp_lightning.data.rows import UNLABELLED
from memcomp_lightning.errors import require, require_count


@dataclass(frozen=True, slots=True)
class PixelLayout:
    """Which pixels of a picture the visible units are.

    Args:
        height: Rows of the picture, >= 1.
        width: Columns of the picture, >= 1.
        pixels: Pixel of each visible unit, counted row by row from 0; None means all of them, in order.

    >>> PixelLayout(height=2, width=2, pixels=(0, 3)).to_picture(torch.ones(2)).tolist()
    [[1.0, 0.0], [0.0, 1.0]]
    """

    height: int
    width: int
    pixels: tuple[int, ...] | None = None

    def __post_init__(self) -> None:
        require_count("height", self.height)
        require_count("width", self.width)
        if self.pixels is not None:
            n_pixels = self.height * self.width
            inside = all(0 <= pixel < n_pixels for pixel in self.pixels)
            distinct = len(set(self.pixels)) == len(self.pixels) > 0
            allowed = f"at least one pixel, each once, from 0 to {n_pixels - 1} (height * width - 1)"
            require(inside and distinct, "pixels", self.pixels, allowed)

    @property
    def n_visible(self) -> int:
        """Number of visible units."""
        return self.height * self.width if self.pixels is None else len(self.pixels)

    def to_picture(self, v: Float[Tensor, "*leading n_visible"]) -> Float[Tensor, "*leading height width"]:
        """Return the units as pictures, with 0 at the pixels that are no unit."""
        require(v.shape[-1] == self.n_visible, "v.shape[-1]", v.shape[-1], f"{self.n_visible} visible units")
        if self.pixels is None:
            return v.reshape(*v.shape[:-1], self.height, self.width)
        picture = v.new_zeros(*v.shape[:-1], self.height * self.width)
        picture[..., list(self.pixels)] = v
        return picture.view(*v.shape[:-1], self.height, self.width)


@dataclass(frozen=True, slots=True, eq=False)
class ImageData:
    """A training set and a test set of images with labels, or some of them with labels.

    Args:
        train_v: Intensities in [0, 1], float32, ``(n_train, n_visible)``; NaN is a missing value.
        train_label: Class indices, int64, -1 where an image has none, ``(n_train,)``.
        test_v: Intensities in [0, 1], float32, ``(n_test, n_visible)``.
        test_label: The same of the test images, ``(n_test,)``.
        n_classes: Number of classes; labels run from 0 to ``n_classes - 1``.
        layout: Where the visible units lie in the picture.
        name: Name of the data set, for reports.
        train_observed: Where ``train_v`` is known, a mask of its shape; None is wherever it is not NaN.
        test_observed: The same of ``test_v``.
    """

    train_v: Tensor
    train_label: Tensor
    test_v: Tensor
    test_label: Tensor
    n_classes: int
    layout: PixelLayout
    name: str
    train_observed: Tensor | None = None
    test_observed: Tensor | None = None

    def __post_init__(self) -> None:
        require_count("n_classes", self.n_classes)
        for subset in ("train", "test"):
            v, observed = getattr(self, f"{subset}_v"), getattr(self, f"{subset}_observed")
            _check_shape(subset, v, self)
            v, observed = split_missing(v, observed, subset)
            object.__setattr__(self, f"{subset}_v", v)
            object.__setattr__(self, f"{subset}_observed", observed)
            _check(subset, v, getattr(self, f"{subset}_label"), self)

    @property
    def n_visible(self) -> int:
        """Number of visible units."""
        return self.layout.n_visible


class ImageSource(Protocol):
    """The settings of a data set; nothing is read before ``load``."""

    def load(self) -> ImageData:
        """Return the images, from memory, from disk or from the network."""


def same_patterns(
    v: Tensor, label: Tensor, n_classes: int, layout: PixelLayout, name: str, copies: int
) -> ImageData:
    """Data whose test set is all patterns, and whose training set holds each of them so many times."""
    train_v, train_label = v.repeat(copies, 1), label.repeat(copies)
    return ImageData(train_v, train_label, v, label, n_classes, layout, name)


def _check_shape(subset: str, v: Tensor, images: ImageData) -> None:
    name, n_visible = f"{subset}_v", images.layout.n_visible
    require(v.dtype == torch.float32, f"{name}.dtype", v.dtype, "torch.float32", "Convert with .float().")
    matches = v.ndim == 2 and v.shape[0] >= 1 and v.shape[1] == n_visible
    allowed = f"(n, {n_visible}): n >= 1 images of the {n_visible} units of the pixel layout"
    remedy = "Flatten each image, or give the layout that belongs to these images."
    require(matches, f"{name}.shape", tuple(v.shape), allowed, remedy)


def _check(subset: str, v: Tensor, label: Tensor, images: ImageData) -> None:
    name = f"{subset}_v"
    low, high = v.aminmax()
    if not (low >= 0 and high <= 1):
        row, unit = (~((v >= 0) & (v <= 1))).nonzero()[0].tolist()
        remedy = "Scale the intensities (bytes: divide by 255); NaN is a missing value."
        require(False, f"{name}[{row}, {unit}]", v[row, unit].item(), "a finite value in [0, 1]", remedy)
    name = f"{subset}_label"
    require(label.dtype == torch.int64, f"{name}.dtype", label.dtype, "torch.int64", "Convert with .long().")
    allowed = f"({v.shape[0]},), one label for each image of {subset}_v"
    require(label.shape == v.shape[:1], f"{name}.shape", tuple(label.shape), allowed)
    outside = ((label < UNLABELLED) | (label >= images.n_classes)).nonzero()
    if len(outside):
        index = int(outside[0])
        allowed = f"a class index from 0 to {images.n_classes - 1}, or {UNLABELLED} where there is no label"
        remedy = "Number the classes from 0, or set n_classes."
        require(False, f"{name}[{index}]", label[index].item(), allowed, remedy)
