"""Paired comparison of two curves over the same partitions and seeds."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats


class Comparison(NamedTuple):
    """Mean of the differences, its central 95 % interval by Student's t, and the two-sided p value.

    Interval and p value are NaN for a single pair; p is 1 where all differences are 0.
    """

    effect: float
    low: float
    high: float
    p: float
    n: int

    @property
    def is_gain(self) -> bool:
        """Whether the first is better, at the level of 5 %."""
        return self.effect > 0 and self.p < 0.05

    def __str__(self) -> str:
        """For tables.

        >>> str(compare([0.5, 0.6], [0.4, 0.4]))
        '+.150 [-.485, +.785], p = 0.2'
        """
        if math.isnan(self.p):
            return f"{signed(self.effect)}, one pair: no test"
        return f"{signed(self.effect)} [{signed(self.low)}, {signed(self.high)}], p = {self.p:.2g}"


def compare(first: ArrayLike, second: ArrayLike) -> Comparison:
    """Compare first - second, pair by pair."""
    difference = np.asarray(first, dtype=float) - np.asarray(second, dtype=float)
    n, effect = len(difference), float(difference.mean())
    if n == 1:
        return Comparison(effect, math.nan, math.nan, math.nan, 1)
    error = float(difference.std(ddof=1)) / math.sqrt(n)
    if error == 0:
        return Comparison(effect, effect, effect, 1.0 if effect == 0 else 0.0, n)
    half = half_width(difference)
    p = 2 * float(stats.t.sf(abs(effect) / error, n - 1))
    return Comparison(effect, effect - half, effect + half, p, n)


def half_width(values: ArrayLike) -> float:
    """Of the 95 % interval of a mean, by Student's t; NaN of one value."""
    own = np.asarray(values, dtype=float)
    n = len(own)
    return math.nan if n < 2 else float(stats.t.ppf(0.975, n - 1) * own.std(ddof=1) / math.sqrt(n))


def accounts_for(control: ArrayLike, better: ArrayLike, gain: Comparison) -> bool:
    """Whether a control explains more than half of a gain of ``better``, with all of its 95 % interval."""
    return compare(better, control).high < gain.effect / 2


def signed(value: float) -> str:
    """A difference of accuracies: three digits, its sign, no zero before the point.

    >>> signed(-0.0123)
    '-.012'
    """
    return f"{value:+.3f}".replace("0.", ".", 1)
