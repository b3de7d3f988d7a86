"""The shifts of a bar: a distribution that is known, for exact likelihoods."""

from dataclasses import dataclass

import torch

from memcomp_lightning.data.images import ImageData, PixelLayout, same_patterns
from memcomp_lightning.errors import require, require_count


@dataclass(frozen=True, kw_only=True, slots=True)
class ShiftingBars:
    """The cyclic shifts of a bar of ones, one class a shift.

    Training and test set hold the same patterns: the task is to learn their distribution, which is uniform.

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
        name = "inverted_bars" if self.inverted else "shifting_bars"
        layout = PixelLayout(height=1, width=self.n_pixels)
        return same_patterns(v, pixel, self.n_pixels, layout, name, self.copies)
