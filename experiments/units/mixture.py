"""Held-out log-likelihood of RBMs with real visible units on Gaussian mixtures, beside scikit-learn's mixtures.

The densities are known: so is what the best model could have. log Z of the RBMs is exact.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from intervals import interval, shown
from numpy.typing import NDArray
from sklearn.mixture import GaussianMixture
from torch import Tensor
from torch.optim import Adam

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import DBN, Normal
from memcomp_lightning.models.units import Gaussian
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import (
    CD,
    PCD,
    Exact,
    GroundState,
    ModeAssisted,
    ModeSchedule,
    NegativePhaseSampler,
)
from memcomp_lightning.solvers import BruteForce
from memcomp_lightning.training import DivergedError, Greedy, pretrain
from memcomp_lightning.training.schedules import LearningRateDecay

SHAPES = [(2, 3), (5, 4), (10, 5)]
"""Dimensions and components."""

N_TRAIN, N_VALID, N_TEST, BATCH = 2000, 1000, 10_000, 100
HIDDEN, RATES = (2, 4, 6, 8), (0.01, 0.03, 0.1)
COMPONENTS = range(1, 11)
Matrix = NDArray[np.float64]


class Mixture(NamedTuple):
    """Weights ``(k,)``, means ``(k, n)`` and covariances ``(k, n, n)``."""

    weight: Matrix
    mean: Matrix
    covariance: Matrix

    @classmethod
    def draw(cls, n: int, k: int, generator: np.random.Generator) -> "Mixture":
        """Components with axes in all directions, deviations of 0.5 to 1, and means apart."""
        covariance = np.empty((k, n, n))
        for i in range(k):
            axes = np.linalg.qr(generator.normal(size=(n, n)))[0]
            covariance[i] = axes * generator.uniform(0.5, 1.0, n) ** 2 @ axes.T
        mean = generator.normal(size=(k, n)) * 4 / np.sqrt(n)
        return cls(generator.dirichlet(np.full(k, 5.0)), mean, covariance)

    def sample(self, rows: int, generator: np.random.Generator) -> Matrix:
        of = generator.choice(len(self.weight), rows, p=self.weight)
        factor = np.linalg.cholesky(self.covariance)
        noise = generator.normal(size=(rows, self.mean.shape[1]))
        return self.mean[of] + np.einsum("rij,rj->ri", factor[of], noise)

    def log_density(self, x: Matrix) -> Matrix:
        parts = []
        for weight, mean, covariance in zip(*self, strict=True):
            factor = np.linalg.cholesky(covariance)
            z = np.linalg.solve(factor, (x - mean).T)
            norm = np.log(np.diag(factor)).sum() + len(mean) * np.log(2 * np.pi) / 2
            parts.append(np.log(weight) - norm - (z**2).sum(0) / 2)
        return np.logaddexp.reduce(parts, axis=0)


class Data(NamedTuple):
    """Rows of several seeds, ``(n_seeds, rows, n)``, with columns of unit variance, and the true log densities."""

    train: Tensor
    valid: Tensor
    test: Tensor
    truth: list[float]


def data_of(n: int, k: int, seeds: list[int], n_test: int = N_TEST) -> Data:
    parts, truth = list[list[Matrix]](), list[float]()
    for seed in seeds:
        generator = rng.numpy_stream(seed, f"mixture {n} {k}")
        mixture = Mixture.draw(n, k, generator)
        train, valid, test = (mixture.sample(rows, generator) for rows in (N_TRAIN, N_VALID, n_test))
        mean, scale = train.mean(0), train.std(0)
        truth.append(float(mixture.log_density(test).mean() + np.log(scale).sum()))
        parts.append([(x - mean) / scale for x in (train, valid, test)])
    train, valid, test = (torch.tensor(np.stack(x), dtype=torch.float32) for x in zip(*parts, strict=True))
    return Data(train, valid, test, truth)


Make = Callable[[int], NegativePhaseSampler[Any, Any]]
METHODS: dict[str, Make] = {
    "CD-1": lambda n: CD(k=1),
    "PCD-1": lambda n: PCD(k=1, n_chains=BATCH),
    "exact": lambda n: Exact(),
    "PCD-1, mode-assisted": lambda n: ModeAssisted(
        inner=PCD(k=1, n_chains=BATCH),
        mode=GroundState(solver=BruteForce()),
        schedule=ModeSchedule(n_updates=n),
    ),
}


class Scores(NamedTuple):
    """Log-likelihoods a row and seed."""

    valid: list[float]
    test: list[float]


def trained(data: Data, method: str, n_hidden: int, rate: float, passes: int) -> Scores:
    """Of an RBM for each seed, all seeds side by side; minus infinity where training diverged."""
    n_seeds, n_rows, n = data.train.shape
    weights = Normal(std=0.1)
    dbn = DBN(visible=Gaussian(n), hidden_sizes=[n_hidden], replicas=(n_seeds,), weight_init=weights)
    dbn[0].visible.start(data.train.mean(-2), data.train.var(-2))
    batches = Batches(data.train, torch.zeros(n_seeds, n_rows).long(), BATCH, n_rows, shuffle=True, seed=0)
    try:
        for _ in pretrain(
            Greedy(dbn),
            batches,
            METHODS[method](passes * len(batches)),
            iterations=passes,
            optimizer=partial(Adam, lr=rate),
            schedules=[LearningRateDecay(passes)],
            centring=Centring(),
        ):
            pass
    except DivergedError:
        return Scores([-np.inf] * n_seeds, [-np.inf] * n_seeds)
    log_z = log_partition_function(dbn[0])
    valid, test = (log_likelihood(dbn[0], v, log_z).mean(-1).tolist() for v in (data.valid, data.test))
    return Scores(valid, test)


def scikit_learn(data: Data, kind: str) -> Scores:
    """Mixtures by EM, of the number of components that is best on validation rows."""
    valid, test = list[float](), list[float]()
    for seed, rows in enumerate(zip(*(x.double().numpy() for x in data[:3]), strict=True)):
        models = [
            GaussianMixture(k, covariance_type=kind, n_init=3, random_state=seed).fit(rows[0]) for k in COMPONENTS
        ]
        best = max(models, key=lambda model: model.score(rows[1]))
        valid.append(float(best.score(rows[1])))
        test.append(float(best.score(rows[2])))
    return Scores(valid, test)


def measure(*, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each shape and method: test log-likelihood below the true density's, in nats a row."""
    seeds, tuning, passes = ([0, 1], [100], 3) if quick else ([0, 1, 2, 3, 4], [100, 101], 100)
    hidden = (2, 3) if quick else HIDDEN
    for n, k in SHAPES[:1] if quick else SHAPES:
        other, data = data_of(n, k, tuning, 10), data_of(n, k, seeds)
        shape = {"dimensions": n, "components": k, "truth": shown(data.truth)}
        for kind in ("diag", "full"):
            found = scikit_learn(data, kind)
            gap = [a - b for a, b in zip(data.truth, found.test, strict=True)]
            yield {**shape, "model": f"GaussianMixture, {kind}", "below the truth": shown(gap)}
        for method in METHODS:
            # The rate on mixtures that are not measured, the number of hidden units on rows that are not.
            middle = hidden[len(hidden) // 2]
            rate = max(RATES, key=lambda lr: interval(trained(other, method, middle, lr, passes).valid)[0])
            tried = {size: trained(data, method, size, rate, passes) for size in hidden}
            best = [max(hidden, key=lambda size: tried[size].valid[i]) for i in range(len(seeds))]
            gap = [data.truth[i] - tried[size].test[i] for i, size in enumerate(best)]
            row = {**shape, "model": f"RBM, {method}", "below the truth": shown(gap), "rate": rate}
            yield row | {"hidden units": " ".join(map(str, best))}
