"""The 8x8 digits that scikit-learn carries: no download, same number of inputs as reduced MNIST."""

from dataclasses import dataclass

import numpy as np
import torch
from sklearn.datasets import load_digits
from sklearn.model_selection import train_test_split

from memcomp_lightning.data.images import ImageData
from memcomp_lightning.data.pixels import GreySource
from memcomp_lightning.data.reduce import SIX_BY_SIX_WITHOUT_CORNERS, without_corners
from memcomp_lightning.errors import require, require_count


@dataclass(frozen=True, kw_only=True, slots=True)
class Digits(GreySource):
    """Handwritten digits, 32 inputs: 1,437 training and 360 test images in 10 classes.

    One pixel is cropped on each side of the 8x8 picture and the four corners of the remaining 6x6 are
    dropped; grey values 0..16 become [0, 1]. The split keeps the share of each class.

    Args:
        split_seed: Which 80/20 split, 0 to 2^32 - 1. It belongs to the data: keep it when the seed of the
            training varies.
        pixels, threshold, seed: As for :class:`GreySource`.
    """

    split_seed: int = 0

    def __post_init__(self) -> None:
        GreySource.__post_init__(self)
        require_count("split_seed", self.split_seed, minimum=0)
        require(self.split_seed < 2**32, "split_seed", self.split_seed, "an integer from 0 to 2^32 - 1")

    def load_grey(self) -> ImageData:
        """Return the images in grey."""
        digits = load_digits()
        v = without_corners(torch.from_numpy(digits.images)[:, 1:-1, 1:-1].float() / 16)
        label = torch.from_numpy(digits.target).long()
        train, test = train_test_split(
            np.arange(len(label)), test_size=0.2, stratify=label.numpy(), random_state=self.split_seed
        )
        layout = SIX_BY_SIX_WITHOUT_CORNERS
        return ImageData(v[train], label[train], v[test], label[test], n_classes=10, layout=layout, name="digits")
