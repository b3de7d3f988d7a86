"""Bars and stripes: a distribution that is known, for exact likelihoods."""

from dataclasses import dataclass

import torch

from memcomp_lightning.data.images import ImageData, PixelLayout, same_patterns
from memcomp_lightning.errors import require, require_count


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
        return same_patterns(v, label, 2, layout, "bars_and_stripes", self.copies)
