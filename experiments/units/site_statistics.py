"""How near samples of aligned sequences are to held-out ones: one-site frequencies and two-site correlations.

Pure numpy, and nothing of memcomp_lightning: the environments of other packages import this file, too. The name is
not `statistics`, because a folder on the path of imports would hide the standard library's module of that name.

Sequences are rows of state indices: (n, L) integers in 0..q-1.
"""

from collections.abc import Iterator

import numpy as np

N_STATES = 21
"""Twenty amino acids and the gap, in the order of ALPHABET."""
ALPHABET = "-ACDEFGHIKLMNPQRSTVWY"
RNA = "-ACGU"

_ROWS_AT_ONCE = 2048


def one_hot(indices: np.ndarray, n_states: int = N_STATES) -> np.ndarray:
    """The rows with one unit for each state of each site.

    Args:
        indices: (n, L) integers in 0..n_states-1.
        n_states: Number of states of a site, q.

    Returns:
        (n, L * q) floats of 0 and 1; the unit of site i and state a is in column i q + a.

    Raises:
        ValueError: The rows are no matrix of integers in 0..n_states-1.
    """
    indices = np.asarray(indices)
    if indices.ndim != 2 or not np.issubdtype(indices.dtype, np.integer) or indices.size == 0:
        raise ValueError(
            f"indices of shape {indices.shape} and type {indices.dtype}: expected (n, L) integers, n, L > 0"
        )
    if indices.min() < 0 or indices.max() >= n_states:
        raise ValueError(f"indices in {indices.min()}..{indices.max()}: expected 0..{n_states - 1}")
    n, n_sites = indices.shape
    units = np.zeros((n, n_sites * n_states))
    np.put_along_axis(units, indices + n_states * np.arange(n_sites), 1.0, axis=1)
    return units


def one_site(indices: np.ndarray, n_states: int = N_STATES, weights: np.ndarray | None = None) -> np.ndarray:
    """How often each site is in each state: f_i(a) = sum_n w_n [x_ni = a] / sum_n w_n.

    Args:
        indices: (n, L) integers in 0..n_states-1.
        n_states: Number of states of a site, q.
        weights: (n,) weights of the rows, >= 0 and not all 0; all equal where None.

    Returns:
        (L, q) frequencies; those of a site sum to 1.

    Raises:
        ValueError: Rows or weights are not as above.
    """
    total = sum(w @ x for x, w in _blocks(indices, n_states, weights))
    return np.asarray(total).reshape(-1, n_states)


def connected(indices: np.ndarray, n_states: int = N_STATES, weights: np.ndarray | None = None) -> np.ndarray:
    """What two sites have in common beyond their own frequencies: C_ij(a, b) = f_ij(a, b) - f_i(a) f_j(b).

    f_ij(a, b) = sum_n w_n [x_ni = a] [x_nj = b] / sum_n w_n.

    Args:
        indices: (n, L) integers in 0..n_states-1.
        n_states: Number of states of a site, q.
        weights: (n,) weights of the rows, >= 0 and not all 0; all equal where None.

    Returns:
        (L, q, L, q) covariances of the one-hot units, those of a site with itself included.

    Raises:
        ValueError: Rows or weights are not as above.
    """
    # Covariances about the means, so that no digits are lost where both terms are nearly equal.
    mean = one_site(indices, n_states, weights).ravel()
    total = sum((w * (x - mean).T) @ (x - mean) for x, w in _blocks(indices, n_states, weights))
    n_sites = len(mean) // n_states
    return np.asarray(total).reshape(n_sites, n_states, n_sites, n_states)


def pairs(correlations: np.ndarray) -> np.ndarray:
    """The correlations of different sites, each pair of sites once.

    Args:
        correlations: (L, q, L, q), as `connected` gives them.

    Returns:
        (L (L - 1) / 2 * q^2,) values for i < j.
    """
    first, second = np.triu_indices(len(correlations), k=1)
    return correlations[first, :, second, :].ravel()


def pearson(a: np.ndarray, b: np.ndarray) -> float:
    """Pearson's correlation of two arrays of one shape; nan where one of them is constant."""
    a, b = np.ravel(a) - np.mean(a), np.ravel(b) - np.mean(b)
    norm = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / norm) if norm > 0 else float("nan")


def slope(a: np.ndarray, b: np.ndarray) -> float:
    """Slope of the line through the points (b, a) by least squares; below 1 where a is too weak.

    Pearson's correlation forgets the scale; this tells it. Noise of b pulls it towards 0, so that a slope is to be
    read beside that of the training rows. nan where b is constant.
    """
    a, b = np.ravel(a) - np.mean(a), np.ravel(b) - np.mean(b)
    return float(a @ b / (b @ b)) if b @ b > 0 else float("nan")


def rms(a: np.ndarray, b: np.ndarray) -> float:
    """Root of the mean squared difference of two arrays of one shape."""
    return float(np.sqrt(np.mean((np.asarray(a) - np.asarray(b)) ** 2)))


def compare(
    samples: np.ndarray,
    held_out: np.ndarray,
    train: np.ndarray,
    n_states: int = N_STATES,
    *,
    sample_weights: np.ndarray | None = None,
    held_out_weights: np.ndarray | None = None,
    train_weights: np.ndarray | None = None,
) -> dict[str, float]:
    """Samples beside held-out rows, and training rows beside held-out rows as the ceiling.

    The ceiling is what the finite number of held-out rows leaves: a model that gave the training rows back would
    reach it. Its noise depends on the number of training rows, so that more or fewer samples are not quite
    comparable with it.

    Args:
        samples: (n, L) integers in 0..n_states-1, what the model drew.
        held_out: (m, L), rows that no model saw.
        train: (k, L), rows that the model was trained on.
        n_states: Number of states of a site, q.
        sample_weights: (n,) weights of the samples, or None.
        held_out_weights: (m,) weights of the held-out rows, or None.
        train_weights: (k,) weights of the training rows, or None.

    Returns:
        For f_i(a) (``one_site``) and for C_ij(a, b) with i < j (``two_site``): ``..._pearson``, ``..._slope`` and
        ``..._rms``, and the same of the training rows as ``ceiling_...``.

    Raises:
        ValueError: Rows or weights are not as above, or the sets have different numbers of sites.
    """
    sites = {np.shape(rows)[1:] for rows in (samples, held_out, train)}
    if len(sites) != 1:
        raise ValueError(f"rows of the shapes {sorted(sites)}: expected one number of sites")
    target = _summary(held_out, n_states, held_out_weights)
    result = {}
    for prefix, rows, weights in (("", samples, sample_weights), ("ceiling_", train, train_weights)):
        for name, ours, theirs in zip(
            ("one_site", "two_site"), _summary(rows, n_states, weights), target, strict=True
        ):
            for measure in (pearson, slope, rms):
                result[f"{prefix}{name}_{measure.__name__}"] = measure(ours, theirs)
    return result


def _summary(rows: np.ndarray, n_states: int, weights: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    return one_site(rows, n_states, weights), pairs(connected(rows, n_states, weights))


def _blocks(
    indices: np.ndarray, n_states: int, weights: np.ndarray | None
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """One-hot rows, some at once, and their shares of the whole weight."""
    n = len(indices)
    weights = np.ones(n) if weights is None else np.asarray(weights, dtype=np.float64)
    if weights.shape != (n,) or not (weights >= 0).all() or not 0 < weights.sum() < np.inf:
        raise ValueError(f"weights of shape {weights.shape}: expected ({n},) finite ones, >= 0 and not all 0")
    shares = weights / weights.sum()
    for begin in range(0, max(n, 1), _ROWS_AT_ONCE):
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        yield one_hot(indices[rows], n_states), shares[rows]
