"""Mixtures with a known density, and the scores of models of them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from memcomp_lightning import rng

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "units"))
import mixture
from intervals import interval


def test_the_density_is_that_of_the_samples():
    known = mixture.Mixture.draw(3, 2, rng.numpy_stream(0, "mixture"))
    x = known.sample(20_000, rng.numpy_stream(0, "rows"))
    parts = [w * multivariate_normal(m, c).pdf(x[:50]) for w, m, c in zip(*known, strict=True)]
    np.testing.assert_allclose(known.log_density(x[:50]), np.log(np.sum(parts, axis=0)))
    error = x.std(0) / len(x) ** 0.5
    assert (np.abs(x.mean(0) - known.weight @ known.mean) < 6 * error).all()
    assert (np.abs(x.mean(0) - known.weight[::-1] @ known.mean) > 6 * error).any()
    second = sum(w * (c + np.outer(m, m)) for w, m, c in zip(*known, strict=True))
    np.testing.assert_allclose(x.T @ x / len(x), second, atol=0.5)


def test_models_are_below_the_truth_and_training_raises_them():
    data = mixture.data_of(2, 3, [0, 1], 2000)
    short, longer = (mixture.trained(data, "exact", 4, 0.1, passes) for passes in (1, 10))
    best = mixture.scikit_learn(data, "full")
    for i in range(2):
        assert short.test[i] < longer.test[i] < best.test[i] < data.truth[i] + 0.05


def test_intervals_are_students():
    assert interval([1.0, 2.0, 3.0]) == (2.0, pytest.approx(4.302653 / 3**0.5))
