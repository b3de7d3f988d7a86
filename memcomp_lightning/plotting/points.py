"""Rows of numbers, as pictures take them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]


class Points(NamedTuple):
    """Rows of data or of samples.

    Attributes:
        x: ``(n, n_entries)``; NaN is missing.
        weight: How often each row counts, > 0, ``(n,)``; None is once.
    """

    x: NDArray[np.floating]
    weight: NDArray[np.floating] | None = None

    @property
    def weights(self) -> Numbers:
        """One for each row."""
        return np.ones(len(self.x)) if self.weight is None else np.asarray(self.weight, dtype=np.float64)

    def means(self) -> Numbers:
        """Weighted mean of the known values of each entry; 0 where there are none."""
        known = ~np.isnan(self.x)
        total = self.weights @ np.where(known, self.x, 0.0)
        found: Numbers = total / np.maximum(self.weights @ known, np.finfo(np.float64).tiny)
        return found
