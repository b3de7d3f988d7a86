"""Rows of bits, categories and real numbers whose density is known: latent classes, and real numbers that follow
a category and each other.
"""

from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

Matrix = NDArray[np.float64]

N_BITS, SIZES, N_REAL = 6, (3, 5, 8), 4


class MixedTable(NamedTuple):
    r"""The distribution :math:`p(x) = \sum_z w_z \prod_j p(b_j|z) \prod_k p(c_k|z) N(r; m_z + a_{c_1}, S)`.

    Attributes:
        weight: Of the classes, ``(n_classes,)``.
        bit: Probability that a bit is 1, ``(n_classes, n_bits)``.
        word: Of each value of each category, ``(n_classes, q)`` each.
        mean: Of the real columns, ``(n_classes, n_real)``.
        shift: What the first category adds, ``(q_1, n_real)``.
        factor: Lower triangle whose square S is the covariance given class and category.
    """

    weight: Matrix
    bit: Matrix
    word: list[Matrix]
    mean: Matrix
    shift: Matrix
    factor: Matrix

    @classmethod
    def draw(cls, generator: np.random.Generator, *, n_classes: int = 4) -> "MixedTable":
        """Classes that differ in every column; real columns of scales between .1 and 1,000."""
        scale = 10.0 ** generator.uniform(-1, 3, N_REAL)
        axes = np.linalg.qr(generator.normal(size=(N_REAL, N_REAL)))[0]
        covariance = axes * generator.uniform(0.2, 1.0, N_REAL) ** 2 @ axes.T
        return cls(
            generator.dirichlet(np.full(n_classes, 5.0)),
            generator.uniform(0.05, 0.95, (n_classes, N_BITS)),
            [generator.dirichlet(np.full(q, 0.7), n_classes) for q in SIZES],
            generator.normal(size=(n_classes, N_REAL)) * 1.5 * scale,
            generator.normal(size=(SIZES[0], N_REAL)) * 0.7 * scale,
            np.linalg.cholesky(covariance) * scale[:, None],
        )

    def sample(self, n: int, generator: np.random.Generator) -> pd.DataFrame:
        """Rows with bits ``no`` and ``yes``, categories of words, and numbers."""
        z = generator.choice(len(self.weight), n, p=self.weight)
        bits = generator.random((n, N_BITS)) < self.bit[z]
        columns = {f"bit {j}": np.where(bits[:, j], "yes", "no") for j in range(N_BITS)}
        for k, probability in enumerate(self.word):
            below = probability.cumsum(-1)[z]
            state = (below < generator.random((n, 1))).sum(-1).clip(max=probability.shape[1] - 1)
            columns[f"word {k}"] = np.array([f"w{a}" for a in state])
            if k == 0:
                shift = self.shift[state]
        real = self.mean[z] + shift + generator.normal(size=(n, N_REAL)) @ self.factor.T
        return pd.DataFrame(columns | {f"real {j}": real[:, j] for j in range(N_REAL)})

    def log_density(self, rows: pd.DataFrame) -> Matrix:
        """Of each row, in nats."""
        bits = np.stack([rows[f"bit {j}"] == "yes" for j in range(N_BITS)], axis=-1)[:, None]
        log_p = np.log(self.weight) + np.where(bits, np.log(self.bit), np.log1p(-self.bit)).sum(-1)
        real = rows[[f"real {j}" for j in range(N_REAL)]].to_numpy()
        for k, probability in enumerate(self.word):
            state = rows[f"word {k}"].str[1:].astype(int).to_numpy()
            log_p += np.log(probability[:, state]).T
            if k == 0:
                real = real - self.shift[state]
        deviation = np.linalg.solve(self.factor, (real[:, None] - self.mean)[..., None])[..., 0]
        log_p -= (deviation**2).sum(-1) / 2 + np.log(np.diag(self.factor)).sum() + N_REAL * np.log(2 * np.pi) / 2
        return np.asarray(np.logaddexp.reduce(log_p, axis=1))
