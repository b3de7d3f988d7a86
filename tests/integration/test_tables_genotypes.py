"""Genotypes: their exact probabilities, and that methods find what is in them."""

import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from memcomp_lightning import rng

sys.path.insert(0, str(Path(__file__).parents[2] / "experiments" / "tables"))
import genotypes
from haplotypes import Panel
from medians import shown


@pytest.fixture
def panel():
    return Panel.draw(
        rng.numpy_stream(0, "panel"), n_blocks=2, n_sites_of_block=2, n_founders=3, n_populations=2
    )._replace(switch=0.2, error=0.05)


def every_row(panel):
    return np.array(list(product(range(3), repeat=panel.founders.shape[0] * panel.founders.shape[2])))


def test_the_likelihood_is_that_of_the_samples(panel):
    states = every_row(panel)
    p = np.exp(panel.exact(states, np.ones_like(states, dtype=bool)).log_likelihood)
    assert p.sum() == pytest.approx(1.0)
    n = 20_000
    drawn = panel.sample(n, rng.numpy_stream(1, "rows"))
    counts = np.bincount(drawn @ 3 ** np.arange(states.shape[1] - 1, -1, -1), minlength=len(states))
    chi2 = ((counts - n * p) ** 2 / (n * p)).sum()
    assert abs(chi2 - len(states) + 1) < 5 * (2 * len(states)) ** 0.5
    q = np.exp(panel._replace(switch=0.5).exact(states, np.ones_like(states, dtype=bool)).log_likelihood)
    assert ((counts - n * q) ** 2 / (n * q)).sum() > 2 * len(states)


def test_the_probabilities_of_gaps_are_those_of_all_completions(panel):
    states = every_row(panel)
    p = np.exp(panel.exact(states, np.ones_like(states, dtype=bool)).log_likelihood)
    row, observed = np.array([[2, 1, 0, 1]]), np.array([[True, False, True, False]])
    found = panel.exact(row, observed)
    fits = (states == row)[:, observed[0]].all(-1)
    assert np.exp(found.log_likelihood[0]) == pytest.approx(p[fits].sum())
    for site in (1, 3):
        expected = [p[fits & (states[:, site] == value)].sum() / p[fits].sum() for value in range(3)]
        np.testing.assert_allclose(found.probability[0, site], expected)


def test_all_methods_are_measured():
    rows = {row["method"]: row for row in genotypes.measure(quick=True)}
    assert list(rows) == list(genotypes.METHODS)

    def number(method, column):
        return float(rows[method][column].split()[0])

    best, least = "the true distribution", "independent columns, modes"
    for method in ("nearest neighbours", "IterativeImputer", "RBM"):
        assert 0.3 < number(method, "correct") <= number(best, "correct") + 0.1
    assert number(best, "log loss") < number("RBM", "log loss") < number(least, "log loss") + 0.2
    # Independent columns know nothing of what goes together.
    assert number(best, "AUC, shuffled") > number(least, "AUC, shuffled") + 0.1
    assert abs(number(least, "AUC, shuffled") - 0.5) < 0.1


def test_medians_have_the_range():
    assert shown([3.0, 1.0, 2.0], 1) == "2.0 (1.0 to 3.0)"
    assert shown([float("nan"), 1.0]) == ""
