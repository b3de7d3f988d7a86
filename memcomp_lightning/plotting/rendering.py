"""A figure as pixels."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray


def rendered(figure: Figure) -> NDArray[np.uint8]:
    """Draw a figure without pyplot, which would choose a screen.

    Returns:
        ``(height, width, 3)``, red, green and blue.

    >>> rendered(Figure(figsize=(2, 1), dpi=50)).shape
    (50, 100, 3)
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
