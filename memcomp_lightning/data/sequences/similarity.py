"""How many sequences are alike: those of a family are no independent draws."""

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.data.sequences.alphabets import MISSING

ROWS = 512
"""Sequences of a block: what a pair of blocks needs stays in a cache of a megabyte or two."""


def neighbours(numbers: NDArray[np.uint8], similarity: float) -> NDArray[np.int64]:
    r"""For each sequence how many there are, itself included, with so large a share of identical sites.

    The weight of a sequence is one over it (Morcos et al. 2011, PNAS 108, E1293, with a threshold of 0.8); their
    sum is the effective number of sequences. A gap is identical to a gap. Where letters are missing, the share is
    that of the sites that both sequences have.

    All pairs are compared, in whole numbers and in blocks of fixed size: 12,000 sequences of 53 sites take less
    than a second, twice as many four times as long.

    Args:
        numbers: Of the letters, ``(n, n_sites)``; 255 where one is missing.
        similarity: The share, in (0, 1].

    Returns:
        ``(n,)``, >= 1.

    >>> neighbours(np.array([[0, 1, 2, 3], [0, 1, 2, 0], [3, 2, 1, 0]], dtype=np.uint8), 0.75).tolist()
    [2, 2, 1]
    """
    distinct, which, copies = np.unique(numbers, axis=0, return_inverse=True, return_counts=True)
    n, weight = len(distinct), copies.astype(np.float32)
    found = np.zeros(n, dtype=np.float64)
    for i in range(0, n, ROWS):
        for j in range(i, n, ROWS):
            one, other = slice(i, i + ROWS), slice(j, j + ROWS)
            near = _alike(distinct[one], distinct[other], similarity)
            if i == j:
                np.fill_diagonal(near, True)
            near = near.astype(np.float32)
            found[one] += near @ weight[other]
            if i != j:
                found[other] += weight[one] @ near
    return found.round().astype(np.int64)[which.reshape(-1)]


def _alike(a: NDArray[np.uint8], b: NDArray[np.uint8], similarity: float) -> NDArray[np.bool_]:
    """Which rows of a are like which of b, ``(n_a, n_b)``."""
    both = ((a != MISSING).astype(np.float32) @ (b != MISSING).astype(np.float32).T).astype(np.int32)
    # What is missing is identical to nothing.
    identical = _identical(np.where(a == MISSING, MISSING - 1, a).T, b.T)
    # A share of 0.55 of 100 sites is 55 of them, though 0.55 * 100 is a little more in floating point.
    found: NDArray[np.bool_] = (identical >= similarity * both - 1e-9) & (both > 0)
    return found


def _identical(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Number of identical sites, ``(n_sites, n_a)`` and ``(n_sites, n_b)`` to ``(n_a, n_b)``."""
    found = np.zeros((a.shape[1], b.shape[1]), dtype=np.int32)
    same, counted = np.empty(found.shape, dtype=np.bool_), np.empty(found.shape, dtype=np.uint8)
    a, b = np.ascontiguousarray(a), np.ascontiguousarray(b)
    for first in range(0, len(a), 255):  # as many as a byte counts
        counted[:] = 0
        for one, other in zip(a[first : first + 255], b[first : first + 255], strict=True):
            np.equal(one[:, None], other[None, :], out=same)
            counted += same.view(np.uint8)
        found += counted
    return found
