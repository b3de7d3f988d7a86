"""Dropout: hidden units that are left out at random while a network is trained."""

from collections.abc import Sequence

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_some


class Dropout:
    r"""Sets activations to 0 with a probability p, and divides the others by 1 - p, so that means stay.

    Each image has a draw of its own in each update. The network itself knows nothing of it: outside of training
    all its units take part. See Srivastava et al. 2014, Dropout: A Simple Way to Prevent Neural Networks from
    Overfitting.

    Args:
        share: p, in [0, 1).
        generators: Random streams, one for each of the networks that are trained side by side on the first replica
            axis, which it divides; a single one serves any replica axes.
    """

    def __init__(self, share: float, generators: Sequence[Generator]) -> None:
        require_share(share)
        require_some("generators", generators, "at least one random stream")
        self.share = share
        self._generators = generators

    def factor(self, x: Tensor) -> Tensor:
        """Draw what activations ``(*replicas, n, n_units)`` are multiplied by: 0 or 1 / (1 - p)."""
        first, *others = x.shape
        n = len(self._generators)
        drawn = [rng.uniform((first // n, *others), generator=g, like=x) for g in self._generators]
        kept = (drawn[0] if n == 1 else torch.cat(drawn)) >= self.share
        return kept.to(x.dtype) / (1 - self.share)


def require_share(share: object) -> None:
    """Raise a SettingError unless it is a number in [0, 1)."""
    is_number = isinstance(share, int | float) and not isinstance(share, bool)
    require(is_number and 0 <= share < 1, "finetune.dropout", share, "a number in [0, 1)")  # type: ignore[operator]
