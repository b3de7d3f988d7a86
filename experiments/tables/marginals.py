"""How near rows are to others: the distribution of each column, and the correlations of all pairs."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ks_2samp
from torch import Tensor

from memcomp_lightning.data.tables import TableSchema

Matrix = NDArray[np.float64]


class Agreement(NamedTuple):
    """Of two sets of rows.

    Attributes:
        correlations: Pearson's correlation of the correlations of all pairs of entries that are not of one column;
            a category has an entry for each of its values.
        marginal: Largest difference of two shares of rows in any column: of those that have a value, of those that
            are below a number.
    """

    correlations: float
    marginal: float


def agreement(rows: Tensor, others: Tensor, schema: TableSchema) -> Agreement:
    """Compare rows of a table, ``(n, n_sites)`` numbers as its units keep them."""
    a, b = rows.double().numpy(), others.double().numpy()
    largest = 0.0
    for site, column in enumerate(schema.of_sites):
        if column.kind == "real":
            difference = float(ks_2samp(a[:, site], b[:, site], method="asymp").statistic)
        else:
            values = np.arange(len(column.words))[:, None]
            difference = float(np.abs((a[:, site] == values).mean(1) - (b[:, site] == values).mean(1)).max())
        largest = max(largest, difference)
    return Agreement(pearson(*(pairs(schema, x) for x in (a, b))), largest)


def pairs(schema: TableSchema, rows: Matrix) -> Matrix:
    """Correlations of entries of different columns, each once; NaN where an entry is constant."""
    entries, site_of = [], []
    for site, column in enumerate(schema.of_sites):
        category = column.kind == "category"
        states = range(len(column.words)) if category else [None]
        entries += [rows[:, site] if state is None else rows[:, site] == state for state in states]
        site_of += [site] * len(states)
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.corrcoef(np.stack(entries).astype(float))
    first, second = np.triu_indices(len(entries), 1)
    different = np.array(site_of)[first] != np.array(site_of)[second]
    return np.asarray(found[first[different], second[different]])


def pearson(a: Matrix, b: Matrix) -> float:
    """Correlation of the pairs that both have; 0 where one of them is constant."""
    both = np.isfinite(a) & np.isfinite(b)
    a, b = a[both] - a[both].mean(), b[both] - b[both].mean()
    norm = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / norm) if norm > 0 else 0.0
