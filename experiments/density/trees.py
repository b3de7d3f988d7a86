"""The tree of Chow and Liu (1968), and the tree of bits that it is with tables of its own.

The hidden tree needs it, and so it is here, by scipy. deeprob-kit 1.1.0 gives the same log-likelihood. pomegranate
1.1.2 gives it on nltcs, but on plants no more than independent bits have (-31.3 nats instead of -16.5), and on
mushrooms, where a column of the training rows is constant, an IndexError.
"""

from typing import NamedTuple

import numpy as np
from bits import Fitted, Real, Rows, smoothed_means
from numpy.typing import NDArray
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree


class Tree(NamedTuple):
    """A rooted spanning tree of the columns.

    Attributes:
        order: Columns, ``(n_visible,)``, each after its parent; the first is the root.
        parent: Of each column, ``(n_visible,)``; that of the root is -1.
    """

    order: NDArray[np.int64]
    parent: NDArray[np.int64]


def joint_tables(rows: Rows, pseudocount: float) -> Real:
    """p(x_i = a, x_j = b), ``(2, 2, n_visible, n_visible)``, with ``pseudocount`` rows more, spread evenly."""
    x = rows.astype(np.float64)
    both = x.T @ x
    one = np.diagonal(both)
    counts = np.empty((2, 2, *both.shape))
    counts[1, 1], counts[1, 0], counts[0, 1] = both, one[:, None] - both, one[None] - both
    counts[0, 0] = len(rows) - one[:, None] - one[None] + both
    return (counts + pseudocount / 4) / (len(rows) + pseudocount)


def mutual_information(rows: Rows, pseudocount: float) -> Real:
    """Of all pairs of columns, in nats, ``(n_visible, n_visible)``."""
    p = joint_tables(rows, pseudocount)
    means = smoothed_means(rows, pseudocount)
    single = np.stack([1 - means, means])
    product = single[:, None, :, None] * single[None, :, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(p > 0, p * np.log(p / product), 0.0).sum((0, 1)))


def chow_liu_tree(rows: Rows, pseudocount: float) -> Tree:
    """The spanning tree of the greatest sum of mutual information, rooted where that of a column is greatest."""
    shared = mutual_information(rows, pseudocount)
    np.fill_diagonal(shared, 0.0)
    # scipy reads 0 as "no edge", so every weight is made positive.
    tree = minimum_spanning_tree(1.0 + shared.max() - shared)
    order, parent = breadth_first_order(tree, int(shared.sum(0).argmax()), directed=False)
    return Tree(order.astype(np.int64), np.where(parent < 0, -1, parent).astype(np.int64))


def chow_liu(train: Rows, valid: Rows, *, seed: int, pseudocount: float) -> Fitted:
    """The tree with the conditional tables of the training rows."""
    tree = chow_liu_tree(train, pseudocount)
    p = joint_tables(train, pseudocount)
    root, children = tree.order[0], tree.order[1:]
    parents = tree.parent[children]
    table = p[:, :, parents, children]  # of (parent, child)
    log_table = np.log(table / table.sum(1, keepdims=True))
    log_root = np.log(p[:, :, root, root].sum(1))

    def log_likelihood(rows: Rows) -> Real:
        of_children = log_table[rows[:, parents], rows[:, children], np.arange(len(children))].sum(1)
        return np.asarray(log_root[rows[:, root]] + of_children)

    return Fitted(log_likelihood)
