"""The compiled search of ``BranchAndBound``; imported when it is needed, as numba takes time to load."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from memcomp_lightning.compiling import announce_compilation

announce_compilation()

Floats = NDArray[np.float64]


@njit(fastmath=True, cache=True, nogil=True)
def search(
    weight: Floats, linear: Floats, other: Floats, best: float, max_nodes: int
) -> tuple[float, Floats, bool, int]:
    """Find the lowest energy by a depth-first search: unit d is set to 0, then to 1, then left free again.

    Args:
        weight: ``(n, m)``, couplings of the n units that are searched to the m that follow.
        linear: ``(n,)``, biases of the first.
        other: ``(m,)``, biases of the second.
        best: An energy; only states below it are of interest.
        max_nodes: States of a part of the units to look at before giving up.

    Returns:
        The lowest energy (``best`` if none lies below), the state of the n units that has it, whether the search
        came to its end, and the number of nodes.
    """
    n, m = weight.shape
    low, high = np.zeros((n + 1, m)), np.zeros((n + 1, m))  # what the units from d on can add to a field
    for d in range(n - 1, -1, -1):
        low[d] = low[d + 1] + np.minimum(weight[d], 0.0)
        high[d] = high[d + 1] + np.maximum(weight[d], 0.0)
    field, own, value, slope = np.empty((n + 1, m)), np.zeros(n + 1), np.full(n + 1, -1), np.empty(m)
    field[0] = other
    found = np.zeros(n)
    d = 0
    for node in range(max_nodes):
        value[d] += 1
        if value[d] == 2:
            value[d] = -1
            d -= 1
            if d < 0:
                return best, found, True, node
            continue
        own[d + 1] = own[d] + value[d] * linear[d]
        bound = own[d + 1]
        for k in range(m):
            field[d + 1, k] = field[d, k] + value[d] * weight[d, k]
            least, most = field[d + 1, k] + low[d + 1, k], field[d + 1, k] + high[d + 1, k]
            if most <= 0:
                slope[k] = 1.0
                bound += field[d + 1, k]
            elif least >= 0:
                slope[k] = 0.0
            else:
                slope[k] = least / (least - most)
                bound += least - slope[k] * low[d + 1, k]
        for later in range(d + 1, n):
            gain = linear[later]
            for k in range(m):
                gain += slope[k] * weight[later, k]
            bound += min(gain, 0.0)
        if bound < best:
            if d + 1 == n:
                best = bound
                for k in range(n):
                    found[k] = value[k]
            else:
                d += 1
    return best, found, False, max_nodes
