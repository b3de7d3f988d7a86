"""What the compiled kernels share: constants, step size, noise, the motion of the voltages."""

from typing import Final

import numpy as np
from numba import njit

F32: Final = np.float32

BOND: Final = 1
"""Kind of field: bond dynamics; clause dynamics is 0."""

REFRESH: Final = 64
"""Local fields are summed from scratch each so many readings, which bounds their rounding error."""

MAX_SWEEPS: Final = 1000
"""Ends a quench that rounding errors would keep alternating between equal energies."""

FAST_MATH: Final = {"reassoc", "contract", "nsz", "arcp", "nnan", "ninf"}
"""Sums may be reordered, which vector code needs; NaN and infinity keep their meaning."""


@njit(nogil=True, cache=True, inline="always")
def uniform(seed, counter):
    """A number in [-1, 1) that depends on nothing but its arguments: a hash of both (Murmur3's finaliser)."""
    z = (seed + counter * np.uint64(0x9E3779B9)) & np.uint64(0xFFFFFFFF)
    z = ((z ^ (z >> np.uint64(16))) * np.uint64(0x85EBCA6B)) & np.uint64(0xFFFFFFFF)
    z = ((z ^ (z >> np.uint64(13))) * np.uint64(0xC2B2AE35)) & np.uint64(0xFFFFFFFF)
    z = z ^ (z >> np.uint64(16))
    return F32(z >> np.uint64(8)) * F32(2.0**-23) - F32(1)
