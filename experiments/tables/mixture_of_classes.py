"""A mixture for tables of words and numbers: what a Gaussian mixture is to numbers, by EM.

In a class words are independent, of numbers and of each other; numbers have a normal distribution whose covariance
matrix is that of the class.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
States = NDArray[np.int64]


class Classes(NamedTuple):
    """The distribution.

    Attributes:
        log_weight: Of the classes, ``(k,)``.
        log_word: Of each value of each column of words, ``(k, q)`` each.
        mean: Of the numbers, ``(k, n_real)``.
        factor: Lower triangles whose squares are the covariance matrices, ``(k, n_real, n_real)``.
    """

    log_weight: Matrix
    log_word: list[Matrix]
    mean: Matrix
    factor: Matrix

    def log_joint(self, words: States, real: Matrix) -> Matrix:
        """Of rows and classes, ``(n, k)``."""
        found = np.tile(self.log_weight, (len(words), 1))
        for column, log_word in enumerate(self.log_word):
            found += log_word[:, words[:, column]].T
        apart = np.swapaxes(real[:, None] - self.mean, 0, 1)
        deviation = np.linalg.solve(self.factor, np.swapaxes(apart, 1, 2))
        found -= (deviation**2).sum(1).T / 2 + real.shape[1] * np.log(2 * np.pi) / 2
        return np.asarray(found - np.log(np.diagonal(self.factor, axis1=1, axis2=2)).sum(-1))

    def log_density(self, words: States, real: Matrix) -> Matrix:
        """Of each row, in nats."""
        return np.asarray(np.logaddexp.reduce(self.log_joint(words, real), axis=1))

    def sample(self, n: int, generator: np.random.Generator) -> tuple[States, Matrix]:
        """Words ``(n, n_words)`` and numbers ``(n, n_real)``."""
        z = generator.choice(len(self.log_weight), n, p=np.exp(self.log_weight))
        noise = generator.normal(size=(n, self.mean.shape[1], 1))
        words = [_drawn(log_word[z], generator) for log_word in self.log_word]
        return np.stack(words, axis=-1), self.mean[z] + (self.factor[z] @ noise)[..., 0]


def _drawn(log_p: Matrix, generator: np.random.Generator) -> States:
    return (log_p + generator.gumbel(size=log_p.shape)).argmax(-1)


def fitted(share: Matrix, words: States, real: Matrix, sizes: Sequence[int], *, least: float = 1e-3) -> Classes:
    """The likeliest, of rows of which ``share`` (n, k) belongs to each class.

    Args:
        share: Of each row.
        words: States of the columns of words.
        real: Numbers of unit scale.
        sizes: Number of values of each column of words.
        least: Added to variances; every value counts as seen once more.
    """
    n = share.sum(0) + 1e-9
    mean = share.T @ real / n[:, None]
    apart = real[:, None] - mean
    covariance = np.einsum("nk,nki,nkj->kij", share, apart, apart) / n[:, None, None]
    covariance += least * np.eye(real.shape[1])
    log_word = []
    for column, size in enumerate(sizes):
        counts = share.T @ np.eye(size)[words[:, column]] + 1.0
        log_word.append(np.log(counts / counts.sum(-1, keepdims=True)))
    return Classes(np.log(n / n.sum()), log_word, mean, np.linalg.cholesky(covariance))


def fit(
    words: States,
    real: Matrix,
    sizes: Sequence[int],
    *,
    n_classes: int,
    generator: np.random.Generator,
    n_starts: int = 3,
    n_steps: int = 200,
) -> Classes:
    """By EM from random rows as centres; the likeliest of several starts."""
    best: tuple[float, Classes] | None = None
    entries = np.concatenate([real, *(np.eye(size)[words[:, j]] for j, size in enumerate(sizes))], axis=-1)
    for _ in range(n_starts):
        centres = entries[generator.choice(len(entries), n_classes, replace=False)]
        nearest = ((entries[:, None] - centres) ** 2).sum(-1).argmin(-1)
        share = np.eye(n_classes)[nearest]
        before = -np.inf
        for _ in range(n_steps):
            found = fitted(share, words, real, sizes)
            joint = found.log_joint(words, real)
            log_p = np.logaddexp.reduce(joint, axis=1)
            share, mean = np.exp(joint - log_p[:, None]), float(log_p.mean())
            if mean - before < 1e-5:
                break
            before = mean
        if best is None or mean > best[0]:
            best = (mean, found)
    assert best is not None
    return best[1]
