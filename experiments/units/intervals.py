"""Means over seeds with intervals."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import t


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and half of the central 95 % interval by Student's t."""
    x = np.asarray(values, dtype=float)
    if len(x) < 2:
        return float(x.mean()), float("nan")
    return float(x.mean()), float(t.ppf(0.975, len(x) - 1) * x.std(ddof=1) / np.sqrt(len(x)))


def shown(values: Sequence[float], digits: int = 3) -> str:
    """``mean +- half``."""
    middle, half = interval(values)
    return f"{middle:.{digits}f} ± {half:.{digits}f}" if np.isfinite(half) else f"{middle:.{digits}f}"
