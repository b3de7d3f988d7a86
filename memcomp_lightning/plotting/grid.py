"""Many small pictures as one."""

import math

import numpy as np
from numpy.typing import NDArray


def picture_grid(pictures: NDArray[np.floating], *, zoom: int = 6, gap: int = 1) -> NDArray[np.float32]:
    """Lay pictures out row by row, nearly square, each stretched to [0, 1] on its own.

    A constant picture becomes mid-grey; gaps and unused places are black. The result is one picture in [0, 1].

    Args:
        pictures: ``(n, height, width)``, any range.
        zoom: Screen pixels a picture pixel, >= 1.
        gap: Picture pixels between pictures, >= 0.

    >>> picture_grid(np.zeros((3, 2, 2)), zoom=1, gap=1).shape
    (5, 5)
    """
    n, height, width = pictures.shape
    n_columns = math.ceil(math.sqrt(n))
    n_rows = math.ceil(n / n_columns)
    grid = np.zeros((n_rows * (height + gap) - gap, n_columns * (width + gap) - gap), dtype=np.float32)
    for index, picture in enumerate(pictures):
        row, column = divmod(index, n_columns)
        low, high = float(picture.min()), float(picture.max())
        stretched = (picture - low) / (high - low) if high > low else np.full_like(picture, 0.5)
        top, left = row * (height + gap), column * (width + gap)
        grid[top : top + height, left : left + width] = stretched
    return np.repeat(np.repeat(grid, zoom, axis=0), zoom, axis=1)
