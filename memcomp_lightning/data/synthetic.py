"""Small sets whose distribution is known, for exact likelihoods."""

from dataclasses import dataclass

import torch
from torch import Tensor

from memcomp_lightning.data.images import ImageData, PixelLayout
from memcomp_lightning.errors import require, require_count


@dataclass(frozen=True, kw_only=True, slots=True)
class ShiftingBars:
    """The cyclic shifts of a bar of ones, one class a shift.

    Training and test set hold the same patterns: the task is to learn the distribution, which is uniform
    over the ``n_pixels`` shifts.

    Args:
        n_pixels: Length of the pattern, >= 2.
        bar_length: Number of ones, 1 to ``n_pixels - 1``.
        inverted: Whether the bar is of zeros among ones.
        copies: How often the training set holds each pattern, >= 1; the test set holds it once.

    >>> ShiftingBars(n_pixels=3, bar_length=2).load().train_v.tolist()
    [[1.0, 1.0, 0.0], [0.0, 1.0, 1.0], [1.0, 0.0, 1.0]]
    """

    n_pixels: int = 9
    bar_length: int = 5
    inverted: bool = False
    copies: int = 1

    def __post_init__(self) -> None:
        require_count("n_pixels", self.n_pixels, minimum=2)
        require_count("bar_length", self.bar_length)
        allowed = f"an integer from 1 to {self.n_pixels - 1} (n_pixels - 1)"
        require(self.bar_length < self.n_pixels, "bar_length", self.bar_length, allowed)
        require_count("copies", self.copies)

    def load(self) -> ImageData:
        """Return the patterns."""
        pixel = torch.arange(self.n_pixels, device="cpu")
        offset = (pixel - pixel[:, None]) % self.n_pixels
        v = ((offset < self.bar_length) ^ self.inverted).float()
        layout, name = (
            PixelLayout(height=1, width=self.n_pixels),
            "inverted_bars" if self.inverted else "shifting_bars",
        )
        return _same_set(v, pixel, self.n_pixels, layout, name, self.copies)


@dataclass(frozen=True, kw_only=True, slots=True)
class BarsAndStripes:
    """All distinct pictures of whole rows (stripes, class 0) or whole columns (bars, class 1).

    There are ``2 * 2**side - 2`` of them. The all-zero and the all-one picture are both; they are kept once,
    in class 0. Training and test set hold the same pictures.

    Args:
        side: Height and width, 2 to 12.
        copies: How often the training set holds each picture, >= 1; the test set holds it once.

    >>> len(BarsAndStripes(side=3).load().train_v)
    14
    """

    side: int = 3
    copies: int = 1

    def __post_init__(self) -> None:
        require_count("side", self.side, minimum=2)
        remedy = "The number of pictures doubles with each row."
        require(self.side <= 12, "side", self.side, "an integer from 2 to 12", remedy)
        require_count("copies", self.copies)

    def load(self) -> ImageData:
        """Return the pictures, stripes first."""
        side = self.side
        row = torch.arange(side, device="cpu")
        bits = (torch.arange(2**side, device="cpu")[:, None] >> row & 1).float()
        stripes = bits[:, :, None].expand(-1, side, side)
        # The first and the last pattern of bits are the uniform pictures, which the stripes hold already.
        bars = bits[1:-1, None, :].expand(-1, side, side)
        v = torch.cat((stripes, bars)).flatten(1)
        label = (torch.arange(len(v), device="cpu") >= len(stripes)).long()
        layout = PixelLayout(height=side, width=side)
        return _same_set(v, label, 2, layout, "bars_and_stripes", self.copies)


def _same_set(v: Tensor, label: Tensor, n_classes: int, layout: PixelLayout, name: str, copies: int) -> ImageData:
    return ImageData(
        train_v=v.repeat(copies, 1),
        train_label=label.repeat(copies),
        test_v=v,
        test_label=label,
        n_classes=n_classes,
        layout=layout,
        name=name,
    )
