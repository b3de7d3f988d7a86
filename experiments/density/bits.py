"""Independent bits and mixtures of them, by EM.

The mixture of pomegranate 1.1.2 is not used: on tables of 0 and 1 its start, k-means, ends in an IndexError where
rows are repeated (nltcs), and its log-likelihood is nan where a column is constant within a component (dna).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Rows = NDArray[np.uint8]
Real = NDArray[np.float64]

_ITERATIONS, _PATIENCE = 500, 10


@dataclass(frozen=True)
class Fitted:
    """A distribution over rows.

    Attributes:
        log_likelihood: Of each row, in nats, from rows ``(n, n_visible)``.
        note: What a reader should know of this fit, or nothing.
    """

    log_likelihood: Callable[[Rows], Real]
    note: str = ""


class Mixture(NamedTuple):
    """Components of independent bits.

    Attributes:
        log_weight: Of the components, ``(k,)``.
        probability: That a bit is 1, ``(k, n_visible)``, strictly between 0 and 1.
    """

    log_weight: Real
    probability: Real

    def log_joint(self, rows: Rows) -> Real:
        """Of rows and components, ``(n, k)``."""
        off = np.log1p(-self.probability)
        slope = np.log(self.probability) - off
        return np.asarray(rows.astype(float) @ slope.T + off.sum(1) + self.log_weight)

    def log_likelihood(self, rows: Rows) -> Real:
        """Of each row, ``(n,)``."""
        return np.asarray(np.logaddexp.reduce(self.log_joint(rows), axis=1))


def smoothed_means(rows: Rows, pseudocount: float) -> Real:
    """The share of 1 in each column, with ``pseudocount`` rows more, half of them 1."""
    return np.asarray((rows.sum(0) + pseudocount / 2) / (len(rows) + pseudocount))


def independent(train: Rows, valid: Rows, *, seed: int, pseudocount: float) -> Fitted:
    """Each column by itself."""
    return Fitted(Mixture(np.zeros(1), smoothed_means(train, pseudocount)[None]).log_likelihood)


def mixture(train: Rows, valid: Rows, *, seed: int, components: int, pseudocount: float) -> Fitted:
    """EM from random rows of the table, until the validation rows stop to gain.

    A component has ``pseudocount`` rows more, which are independent bits with the means of the whole table.
    """
    generator = np.random.default_rng(seed)
    means = smoothed_means(train, 1.0)
    seeds = train[generator.choice(len(train), components, replace=len(train) < components)]
    now = Mixture(np.full(components, -np.log(components)), 0.5 * means + 0.25 + 0.5 * (seeds - 0.5) * 0.98)
    best, best_valid, waited = now, -np.inf, 0
    x = train.astype(float)
    for _ in range(_ITERATIONS):
        joint = now.log_joint(train)
        share = np.exp(joint - np.logaddexp.reduce(joint, axis=1)[:, None])
        size = share.sum(0)
        probability = (share.T @ x + pseudocount * means) / (size + pseudocount)[:, None]
        now = Mixture(np.log((size + pseudocount) / (size + pseudocount).sum()), probability)
        reached = float(now.log_likelihood(valid).mean())
        if reached > best_valid + 1e-4:
            best, best_valid, waited = now, reached, 0
        else:
            waited += 1
            if waited == _PATIENCE:
                break
    return Fitted(best.log_likelihood)
