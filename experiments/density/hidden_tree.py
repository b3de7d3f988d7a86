"""A hidden Chow-Liu tree: a latent of h states for each column, and between latents the tree of Chow and Liu.

    p(x) = sum over z of p(z_r) prod_i p(z_i | z_parent(i)) prod_i p(x_i | z_i)

Source: A. Liu and G. Van den Broeck, "Tractable regularization of probabilistic circuits", NeurIPS 2021. Messages
are exact; they are divided by their sum at every column, and the logarithms of these sums add up to log p(x).
Learned by EM, first of mini-batches with a falling step, then of all rows.
"""

from typing import NamedTuple

import numpy as np
from bits import Fitted, Real, Rows, smoothed_means
from numpy.typing import NDArray
from trees import Tree, chow_liu_tree

Single = NDArray[np.float32]

_NUMBERS_AT_ONCE = 8000  # of rows times states: messages of one column then fit the cache
_ONLINE_PASSES, _FULL_PASSES, _PATIENCE = 20, 80, 6
_LEAST_GAIN = 3e-4


class Tables(NamedTuple):
    """Probabilities, or expected counts of the same shape.

    Attributes:
        start: Of the states of the root, ``(h,)``.
        step: Of a state given that of the parent, ``(n_visible, h parent, h)``; unused for the root.
        bit: That a column is 0 or 1 given its state, ``(n_visible, h, 2)``.
    """

    start: Single
    step: Single
    bit: Single


class Upward(NamedTuple):
    """Messages towards the root for n rows: ``belief``, ``message`` ``(n_visible, h, n)``, log p(x) ``(n,)``."""

    belief: Single
    message: Single
    log_likelihood: Real


def upward(tables: Tables, tree: Tree, rows: Rows) -> Upward:
    """Belief in a state from what is below it, scaled to sum 1, and what the parent hears of it."""
    x = rows.T[:, None, :, None].astype(np.int64)
    belief = np.take_along_axis(tables.bit[:, :, None, :], x, axis=3)[..., 0]
    message = np.empty_like(belief)
    log_likelihood = np.zeros(len(rows))
    for i in tree.order[:0:-1]:
        scale = belief[i].sum(0)
        belief[i] /= scale
        log_likelihood += np.log(scale)
        np.matmul(tables.step[i], belief[i], out=message[i])
        belief[tree.parent[i]] *= message[i]
    root = tree.order[0]
    return Upward(belief, message, log_likelihood + np.log(tables.start @ belief[root]))


def expected_counts(tables: Tables, tree: Tree, rows: Rows) -> tuple[Tables, float]:
    """How often states and steps are expected in the rows, and the sum of their log p(x)."""
    up = upward(tables, tree, rows)
    counts = Tables(*(np.zeros_like(table) for table in tables))
    root = tree.order[0]
    posterior = np.empty_like(up.belief)
    posterior[root] = tables.start[:, None] * up.belief[root]
    posterior[root] /= posterior[root].sum(0)
    for i in tree.order[1:]:
        above = posterior[tree.parent[i]] / up.message[i]
        np.matmul(above, up.belief[i].T, out=counts.step[i])
        np.matmul(tables.step[i].T, above, out=posterior[i])
        posterior[i] *= up.belief[i]
    counts.step[...] *= tables.step
    counts.start[...] = posterior[root].sum(1)
    np.matmul(posterior, rows.T[:, :, None].astype(np.float32), out=counts.bit[:, :, 1:])
    counts.bit[:, :, 0] = posterior.sum(2) - counts.bit[:, :, 1]
    return counts, float(up.log_likelihood.sum())


def maximised(counts: Tables, pseudocount: float, means: Real) -> Tables:
    """Tables from counts, each state with ``pseudocount`` rows more: even steps, bits like the whole table's."""
    prior = pseudocount * np.stack([1 - means, means], axis=1)[:, None]
    start = counts.start + pseudocount / len(counts.start)
    step = counts.step + pseudocount / len(counts.start)
    bit = np.maximum(counts.bit, 0.0) + prior
    return Tables(
        (start / start.sum()).astype(np.float32),
        (step / step.sum(2, keepdims=True)).astype(np.float32),
        (bit / bit.sum(2, keepdims=True)).astype(np.float32),
    )


def first_tables(states: int, train: Rows, means: Real, generator: np.random.Generator) -> Tables:
    """A state is a random row of the table, the same one in all columns, and steps keep it half of the time.

    From random tables EM mostly ends lower on validation rows: with 8 states by .5 nats on plants, 1.0 on
    mushrooms, .3 on nips, .02 on nltcs, .01 on dna; with 16 by .1 on mushrooms, but higher by .05 on dna.
    """
    n = train.shape[1]
    rows = train[generator.choice(len(train), states, replace=len(train) < states)]
    one = 0.8 * (0.15 + 0.7 * rows.T) + 0.2 * means[:, None]
    step = 0.5 * np.eye(states) + 0.5 * generator.dirichlet(np.ones(states), size=(n, states))
    start = generator.dirichlet(np.full(states, 5.0))
    return Tables(
        start.astype(np.float32), step.astype(np.float32), np.stack([1 - one, one], axis=2).astype(np.float32)
    )


def blocks(rows: Rows, states: int) -> list[Rows]:
    """The rows in parts."""
    at_once = max(_NUMBERS_AT_ONCE // states, 1)
    return [rows[k : k + at_once] for k in range(0, len(rows), at_once)]


def log_likelihood(tables: Tables, tree: Tree, rows: Rows) -> Real:
    """Of each row, in nats, ``(n,)``."""
    parts = blocks(rows, len(tables.start))
    return np.concatenate([upward(tables, tree, part).log_likelihood for part in parts])


def hidden_tree(train: Rows, valid: Rows, *, seed: int, states: int, pseudocount: float) -> Fitted:
    """EM until the validation rows stop to gain; the best tables on these are kept."""
    generator = np.random.default_rng(seed)
    means = smoothed_means(train, 1.0)
    tree = chow_liu_tree(train, 1.0)
    now = first_tables(states, train, means, generator)
    best, best_valid, waited = now, -np.inf, 0

    def better() -> bool:
        nonlocal best, best_valid, waited
        reached = float(log_likelihood(now, tree, valid).mean())
        waited = 0 if reached > best_valid + _LEAST_GAIN else waited + 1
        if reached > best_valid:
            best, best_valid = now, reached
        return waited < _PATIENCE

    n_batches = max(len(blocks(train, states)), min(10, len(train) // 50), 1)
    kept: Tables | None = None
    updates = 0
    for _ in range(_ONLINE_PASSES):
        for part in np.array_split(generator.permutation(len(train)), n_batches):
            counts, _ = expected_counts(now, tree, train[part])
            updates += 1
            weight = (updates + 1) ** -0.6
            share = len(train) / len(part)
            new = Tables(*(share * table for table in counts))
            kept = new if kept is None else Tables(*(k + weight * (c - k) for k, c in zip(kept, new, strict=True)))
            now = maximised(kept, pseudocount, means)
        if not better():
            break
    waited = 0
    now = best
    for _ in range(_FULL_PASSES):
        sums = [expected_counts(now, tree, part)[0] for part in blocks(train, states)]
        now = maximised(Tables(*(sum(parts) for parts in zip(*sums, strict=True))), pseudocount, means)
        if not better():
            break
    return Fitted(lambda rows: log_likelihood(best, tree, rows))
