"""Tables of a known density, and how samples are compared."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from memcomp_lightning import rng
from memcomp_lightning.data.tables import TableSchema
from memcomp_lightning.data.tables.columns import Binary, Category, Real

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "tables"))
import mixed
from conditional_gaussian import N_BITS, N_REAL, SIZES, MixedTable
from marginals import agreement
from mixture_of_classes import fit


@pytest.fixture(scope="module")
def known():
    return MixedTable.draw(rng.numpy_stream(0, "mixed"), n_classes=2)


def test_the_density_is_that_of_a_sum_over_classes(known):
    rows = known.sample(5, rng.numpy_stream(1, "rows"))
    for k in range(5):
        total = 0.0
        for z, weight in enumerate(known.weight):
            p = weight
            for j in range(N_BITS):
                p *= known.bit[z, j] if rows[f"bit {j}"][k] == "yes" else 1 - known.bit[z, j]
            words = [int(rows[f"word {j}"][k][1:]) for j in range(len(SIZES))]
            for probability, word in zip(known.word, words, strict=True):
                p *= probability[z, word]
            mean, covariance = known.mean[z] + known.shift[words[0]], known.factor @ known.factor.T
            real = [rows[f"real {j}"][k] for j in range(N_REAL)]
            total += p * multivariate_normal(mean, covariance).pdf(real)
        assert known.log_density(rows)[k] == pytest.approx(np.log(total))


def test_rows_have_the_moments_of_the_density(known):
    rows = known.sample(20_000, rng.numpy_stream(1, "rows"))
    bits = np.stack([rows[f"bit {j}"] == "yes" for j in range(N_BITS)], axis=-1)
    np.testing.assert_allclose(bits.mean(0), known.weight @ known.bit, atol=0.02)
    for k, probability in enumerate(known.word):
        share = [(rows[f"word {k}"] == f"w{a}").mean() for a in range(SIZES[k])]
        np.testing.assert_allclose(share, known.weight @ probability, atol=0.02)
    real = rows[[f"real {j}" for j in range(N_REAL)]].to_numpy()
    mean = known.weight @ (known.mean + known.word[0] @ known.shift)
    assert (np.abs(real.mean(0) - mean) < 5 * real.std(0) / len(real) ** 0.5).all()


def test_samples_are_compared_by_shares_and_by_correlations():
    schema = TableSchema((Binary("a", (0, 1)), Category("b", ("x", "y", "z")), Real("c", 0.0, 1.0)))
    draw = rng.stream(0, "rows")
    word = torch.randint(0, 3, (4000,), generator=draw)
    noise = torch.empty(4000).normal_(generator=draw)
    rows = torch.stack([(word == 1).float(), word.float(), (word == 2) + 0.5 * noise], dim=-1)
    same = agreement(rows[:2000], rows[2000:], schema)
    assert same.correlations > 0.98
    assert same.marginal < 0.06
    shuffled = torch.stack([column[torch.randperm(4000, generator=draw)] for column in rows.T], dim=-1)
    apart = agreement(shuffled[:2000], rows[2000:], schema)
    assert abs(apart.correlations) < 0.5
    assert apart.marginal < 0.06
    moved = rows + torch.tensor([0.0, 0.0, 0.5])
    assert agreement(moved, rows, schema).marginal > 0.2
    assert agreement(moved, rows, schema).correlations == pytest.approx(1.0)
    rarer = rows.clone()
    rarer[:1000, 0] = 0
    share = float(rows[:1000, 0].mean()) / 4
    assert agreement(rarer, rows, schema).marginal == pytest.approx(share, abs=1e-6)


@pytest.fixture(scope="module")
def rows_of_classes(known):
    rows = known.sample(3000, rng.numpy_stream(2, "rows"))
    words = [rows[f"bit {j}"].eq("yes").astype(int) for j in range(N_BITS)]
    words += [rows[f"word {j}"].str[1:].astype(int) for j in range(len(SIZES))]
    real = rows[[f"real {j}" for j in range(N_REAL)]].to_numpy()
    scale = real.std(0)
    density = known.log_density(rows) + np.log(scale).sum()
    return np.stack(words, axis=-1), (real - real.mean(0)) / scale, density, [2] * N_BITS + list(SIZES)


def test_a_mixture_comes_near_a_density_that_is_one(rows_of_classes):
    words, real, density, sizes = rows_of_classes
    generator = rng.numpy_stream(0, "mixture")
    gaps = []
    for k in (1, 6):  # two classes, each of them shifted by a word of three values
        found = fit(words[:2000], real[:2000], sizes, n_classes=k, generator=generator)
        gaps.append(density[2000:].mean() - found.log_density(words[2000:], real[2000:]).mean())
    assert 0 < gaps[1] < 0.4 < 1 < gaps[0]


def test_rows_of_a_mixture_have_its_density(rows_of_classes):
    words, real, _, sizes = rows_of_classes
    found = fit(words, real, sizes, n_classes=6, generator=rng.numpy_stream(0, "mixture"))
    drawn = found.sample(20_000, rng.numpy_stream(1, "drawn"))
    # The mean of log p is minus the entropy, of both what is fitted and what is drawn if these are alike.
    assert found.log_density(*drawn).mean() == pytest.approx(found.log_density(words, real).mean(), abs=0.15)
    log_p = found.log_density(words[:1], real[:1])
    total = 0.0
    for z, weight in enumerate(np.exp(found.log_weight)):
        p = weight * np.prod(
            [np.exp(log_word[z, state]) for log_word, state in zip(found.log_word, words[0], strict=True)]
        )
        total += p * multivariate_normal(found.mean[z], found.factor[z] @ found.factor[z].T).pdf(real[0])
    assert log_p[0] == pytest.approx(np.log(total))


def test_all_models_are_measured():
    rows = {(row["table"], row["model"]): row for row in mixed.measure(quick=True)}
    assert [model for table, model in rows if table == "mixed"] == [
        *("independent columns", "mixture of classes", "RBM at the defaults of 0.2", "RBM", mixed.TEMPERED),
        *("the true density", "training rows"),
    ]

    def number(table, model, column):
        return float(rows[table, model][column].split()[0])

    gain = "above independent columns"
    assert 0 < number("mixed", "RBM", gain) < number("mixed", "the true density", gain)
    assert number("wine", "GaussianMixture", gain) > 1
    for table in ("mixed", "wine"):
        least, most = (number(table, model, "correlations") for model in ("independent columns", "training rows"))
        assert abs(least) < 0.2 < 0.7 < most
        assert rows[table, "RBM"]["log Z"] == "exact"
