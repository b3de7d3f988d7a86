"""Random numbers for compiled searches: a generator of 64 bits, and thresholds of all sweeps drawn beforehand."""

from functools import cache
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from memcomp_lightning.compiling import announce_compilation

announce_compilation()

N_THRESHOLDS = 2**16
"""Logits in the pool. With so many equally spaced quantiles a unit's probability is kept to 1e-5."""


@cache
def thresholds(longest: int) -> NDArray[np.float32]:
    """Logits of equally spaced quantiles in a fixed random order; a unit is on where its log odds are above one.

    A sweep reads them from a random place on. That takes the place of a random number and a logarithm a unit.

    Args:
        longest: Units read at once at most; so many of the first logits stand behind the last again.
    """
    quantile = (np.arange(N_THRESHOLDS) + 0.5) / N_THRESHOLDS
    logits = np.log(quantile / (1 - quantile)).astype(np.float32)
    np.random.default_rng(0).shuffle(logits)
    return np.resize(logits, N_THRESHOLDS + longest)


@njit(nogil=True, cache=True, inline="always")
def begin(state: Any, seed: Any) -> None:
    """Start the generator; seeds next to each other give unlike streams (the finaliser of SplitMix64)."""
    z = seed + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    state[0] = (z ^ (z >> np.uint64(31))) | np.uint64(1)


@njit(nogil=True, cache=True, inline="always")
def draw(state: Any) -> Any:
    """The next 64 bits (xorshift: Marsaglia 2003)."""
    z = state[0]
    z ^= z << np.uint64(13)
    z ^= z >> np.uint64(7)
    z ^= z << np.uint64(17)
    state[0] = z
    return z


@njit(nogil=True, cache=True, inline="always")
def below(state: Any, n: Any) -> Any:
    """An integer from 0 to n - 1, n < 2^31."""
    return np.int64(((draw(state) >> np.uint64(33)) * np.uint64(n)) >> np.uint64(31))
