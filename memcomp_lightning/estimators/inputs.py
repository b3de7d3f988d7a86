"""What the estimators do with a matrix before the units see it: precision, scaling, weights, batches."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.utils.sparsefuncs import min_max_axis
from sklearn.utils.validation import _check_sample_weight
from torch import Tensor

from memcomp_lightning.data import Batches, SparseRows
from memcomp_lightning.models import RBM
from memcomp_lightning.samplers import ModeAssisted

Array: TypeAlias = NDArray[Any]
"""Numbers of any type."""

Matrix: TypeAlias = Any
"""An array ``(n_samples, n_features)``, or a SciPy matrix in CSR form."""

MOST_NUMBERS = 2**22
"""Numbers of a sparse matrix that are held densely at once, but for a mini-batch that has more."""

MOST_REPEATS = 10
"""Mean weight up to which samples of whole weights are repeated in mini-batches."""


class Samples(NamedTuple):
    """What an estimator learns from.

    Attributes:
        X: Their features.
        label: As they were given, or numbers of the classes; zeros in an RBM.
        weight: How often each counts, > 0, in the precision of X; None where all count once.
    """

    X: Matrix
    label: Array
    weight: Array | None = None

    @classmethod
    def that_count(cls, X: Matrix, label: Array, sample_weight: ArrayLike | None) -> "Samples":
        """Return the samples whose weight is not 0; raise a ValueError if the weights are wrong, or all zero."""
        if sample_weight is None:
            return cls(X, label)
        weight: Array = _check_sample_weight(sample_weight, X, dtype=X.dtype, ensure_non_negative=True)
        if not weight.any():
            raise ValueError("sample_weight is zero for every sample: at least one weight must be > 0.")
        return cls(X, label) if (weight == 1).all() else cls(X, label, weight).take(weight > 0)

    def take(self, rows: Array) -> "Samples":
        """Return some of the samples, by their indices or by a mask."""
        return Samples(self.X[rows], self.label[rows], None if self.weight is None else self.weight[rows])

    def astype(self, dtype: np.dtype[Any]) -> "Samples":
        """Return them with features and weights in this precision."""
        weight = None if self.weight is None else self.weight.astype(dtype)
        return self._replace(X=self.X.astype(dtype, copy=False), weight=weight)


@dataclass(frozen=True, slots=True)
class Scaling:
    """Maps the columns that leave [0, 1] in the training data to [0, 1] by their range, and clips all.

    Attributes:
        low: The value that becomes 0, for each column; 0 in the columns that are left as they are.
        width: The value that becomes 1, less ``low``; 1 in the columns that are left as they are.
    """

    low: Array
    width: Array

    @classmethod
    def of(cls, X: Matrix) -> "Scaling":
        """Return the scaling of training data."""
        low, high = min_max_axis(X, axis=0) if sp.issparse(X) else (X.min(0), X.max(0))
        leaves = ((low < 0) | (high > 1)) & (low < high)
        return cls(np.where(leaves, low, 0), np.where(leaves, high - low, 1).astype(X.dtype))

    def apply(self, X: Matrix) -> Matrix:
        """Return intensities in [0, 1], of the type and in the precision of X; X is not changed."""
        if not sp.issparse(X):
            return self._columns(X, slice(None))
        moved = self.low != 0
        if moved.any():  # zeros of these columns become other numbers
            full = sp.csr_array(self._columns(X[:, np.flatnonzero(moved)].toarray(), moved))
            places = np.concatenate((np.flatnonzero(~moved), np.flatnonzero(moved)))
            rest = Scaling(self.low[~moved], self.width[~moved]).apply(X[:, np.flatnonzero(~moved)])
            return sp.csr_array(sp.hstack([rest, full]).tocsr()[:, np.argsort(places)])
        X = sp.csr_array(X, copy=True)
        X.sum_duplicates()
        X.data = np.clip(X.data / self.width.astype(X.dtype)[X.indices], 0, 1)
        return X

    def to_data(self, states: Array) -> Array:
        """Return states in {0, 1} in the units of the data: the ends of the range of a scaled column."""
        width, low = self.width.astype(states.dtype), self.low.astype(states.dtype)
        return np.asarray(states * width + low)

    def _columns(self, X: Array, columns: slice | Array) -> Array:
        low, width = self.low[columns].astype(X.dtype), self.width[columns].astype(X.dtype)
        if (width != 1).any() or low.any():
            X = (X - low) / width
        if X.size and (X.min() < 0 or X.max() > 1):
            X = X.clip(0, 1)
        return X


def log_odds_of(samples: Samples) -> Tensor:
    """Return log (n_on + 1) / (n_off + 1) of each column, where a sample counts as often as its weight says.

    Weights that add up to less than the number of samples are multiplied until they do: a small scale of weights
    says nothing about how much data there is.
    """
    X, _, weight = samples
    if weight is None:
        n, n_on = float(X.shape[0]), np.asarray(X.sum(0)).ravel()
    else:
        n = max(float(weight.sum()), float(len(weight)))
        n_on = n * np.asarray((weight / weight.sum()) @ X).ravel()
    return torch.from_numpy(np.log((n_on + 1) / (n - n_on + 1)))


def batches_of(samples: Samples, *, batch_size: int | None, sampler: object = None, seed: int) -> Batches:
    """Return the batches of scaled data.

    In mini-batches a sample of weight 2 is the same as the sample twice: if all weights are integers with a mean
    up to ``MOST_REPEATS``, samples are repeated by their weights. Otherwise a sample of r times the mean weight
    becomes r copies, rounded up, that share its weight: so no batch is all one heavy sample, and no step is far
    longer than the others. The order in which the samples are given does not matter.
    """
    X, label, weight = samples
    n_counted = X.shape[0] if weight is None else float(weight.sum())
    if batch_size is not None and batch_size < max(X.shape[0], n_counted):
        rows, weight = _laid_out(samples)
        X, label, _ = samples.take(rows)
    if weight is not None and (weight == weight[0]).all():
        weight = None
    n, n_features = X.shape
    size = None if batch_size is None or batch_size >= n else batch_size
    chunk = max(1, MOST_NUMBERS // n_features) if sp.issparse(X) else 10_000
    # Mode assistance draws for each chunk whether the mode is used, so a step must be one chunk.
    chunk = n if isinstance(sampler, ModeAssisted) else max(chunk, size or 0)
    weights = None if weight is None else torch.from_numpy(weight)
    return Batches(tensor_of(X), torch.from_numpy(label), size, chunk, shuffle=True, seed=seed, weight=weights)


def _laid_out(samples: Samples) -> tuple[Array, Array | None]:
    """Return the rows that mini-batches are made of, in an order that the data alone settle, and their weights."""
    X, label, weight = samples
    direction, step = np.random.default_rng(0).standard_normal(X.shape[1]), max(1, MOST_NUMBERS // X.shape[1])
    parts = [X[first : first + step].astype(np.float64) @ direction for first in range(0, X.shape[0], step)]
    # Rounded, because equal rows may differ in the last bits.
    place = np.concatenate(parts).round(9)
    order = np.lexsort((label, place))
    if weight is None:
        return order, None
    weight = weight[order]
    if (weight == np.round(weight)).all() and weight.mean() <= MOST_REPEATS:
        return order.repeat(weight.astype(np.int64)), None
    weight = weight / weight.mean()
    copies = np.ceil(weight - 1e-6)  # in the precision of the weights, which the quotient keeps
    repeats = copies.astype(np.int64)
    return order.repeat(repeats), (weight / copies).repeat(repeats)


def tensor_of(X: Matrix) -> Tensor | SparseRows:
    """Return the same numbers for torch."""
    if sp.issparse(X):
        start, unit = (torch.from_numpy(part.astype(np.int64)) for part in (X.indptr, X.indices))
        return SparseRows(start, unit, torch.from_numpy(X.data), X.shape[1])
    return dense_tensor_of(X)


def dense_tensor_of(X: Array) -> Tensor:
    """Return the same numbers for torch."""
    # torch warns of arrays that it must not write to, as those that joblib maps into memory.
    return torch.from_numpy(np.ascontiguousarray(X) if X.flags.writeable else X.copy())


def dense_parts(X: Matrix) -> Iterator[Tensor]:
    """Yield dense tensors that together have the rows of X, not too many at a time."""
    rows = max(1, MOST_NUMBERS // X.shape[1])
    for first in range(0, X.shape[0], rows):
        part = X[first : first + rows]
        yield dense_tensor_of(part.toarray() if sp.issparse(part) else part)


def hidden_means(rbm: RBM, X: Matrix) -> Tensor:
    """Return E[h | v] of each row, ``(n_samples, n_hidden)``; a sparse matrix stays sparse."""
    if not sp.issparse(X):
        return rbm.hidden_mean(dense_tensor_of(X))
    field = np.asarray(X @ np.ascontiguousarray(rbm.weight.detach().numpy().T))
    return torch.sigmoid(torch.from_numpy(field) + rbm.c)
