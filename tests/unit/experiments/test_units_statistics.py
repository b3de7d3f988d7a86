"""Statistics of aligned sequences: each number against loops over rows, sites and states."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "units"))
import site_statistics
from site_statistics import compare, connected, one_hot, one_site, pairs, pearson, rms, slope

FOLDER = Path(site_statistics.__file__).parent
Q, SITES = 4, 3


@pytest.fixture(params=[False, True], ids=["equal weights", "weights"])
def rows_and_weights(request, monkeypatch):
    monkeypatch.setattr(site_statistics, "_ROWS_AT_ONCE", 7)  # several blocks, the last one smaller
    generator = np.random.default_rng(0)
    rows = generator.integers(Q, size=(40, SITES))
    rows[:, 2] = np.where(generator.random(40) < 0.6, rows[:, 0], rows[:, 2])
    return rows, (generator.random(40) if request.param else None)


def looped(rows, weights):
    """f_i(a) and f_ij(a, b) by counting."""
    weights = [1.0] * len(rows) if weights is None else weights
    single, double = np.zeros((SITES, Q)), np.zeros((SITES, Q, SITES, Q))
    for row, weight in zip(rows, weights, strict=True):
        for i in range(SITES):
            single[i, row[i]] += weight
            for j in range(SITES):
                double[i, row[i], j, row[j]] += weight
    return single / sum(weights), double / sum(weights)


def test_one_hot_has_a_unit_for_each_state_of_each_site():
    assert one_hot(np.array([[0, 2], [1, 1]]), 3).tolist() == [[1, 0, 0, 0, 0, 1], [0, 1, 0, 0, 1, 0]]


def test_frequencies_and_connected_correlations_are_those_of_counting(rows_and_weights):
    single, double = looped(*rows_and_weights)
    rows, weights = rows_and_weights
    np.testing.assert_allclose(one_site(rows, Q, weights), single, atol=1e-14)
    found = connected(rows, Q, weights)
    for i in range(SITES):
        for j in range(SITES):
            for a in range(Q):
                for b in range(Q):
                    expected = double[i, a, j, b] - single[i, a] * single[j, b]
                    assert found[i, a, j, b] == pytest.approx(expected, abs=1e-14)
    assert not np.allclose(found, double, atol=1e-3)  # a mutant that forgets the product of frequencies


def test_weights_of_two_are_rows_that_stand_twice():
    rows = np.random.default_rng(1).integers(Q, size=(12, SITES))
    weights = np.where(np.arange(12) < 5, 2.0, 1.0)
    twice = np.concatenate([rows, rows[:5]])
    np.testing.assert_allclose(connected(rows, Q, weights), connected(twice, Q), atol=1e-14)
    assert not np.allclose(connected(rows, Q), connected(twice, Q), atol=1e-3)


def test_pairs_are_those_of_different_sites_once():
    correlations = np.arange(float((SITES * Q) ** 2)).reshape(SITES, Q, SITES, Q)
    expected = [
        correlations[i, a, j, b]
        for i in range(SITES)
        for j in range(i + 1, SITES)
        for a in range(Q)
        for b in range(Q)
    ]
    assert pairs(correlations).tolist() == expected


def test_pearson_slope_and_rms_are_their_formulas():
    a, b = np.random.default_rng(2).normal(size=(2, 3, 5))
    assert pearson(a, b) == pytest.approx(np.corrcoef(a.ravel(), b.ravel())[0, 1])
    assert slope(a, b) == pytest.approx(np.polyfit(b.ravel(), a.ravel(), 1)[0])
    assert rms(a, b) == pytest.approx(
        sum((x - y) ** 2 for x, y in zip(a.flat, b.flat, strict=True)) ** 0.5 / 15**0.5
    )
    assert np.isnan(pearson(a, np.ones_like(a)))
    assert np.isnan(slope(a, np.ones_like(a)))


def test_comparison_is_of_samples_and_of_training_rows_with_held_out_ones():
    generator = np.random.default_rng(3)
    samples, held_out, train = (generator.integers(Q, size=(n, SITES)) for n in (30, 40, 50))
    weights = generator.random(40)
    found = compare(samples, held_out, train, Q, held_out_weights=weights)
    for prefix, rows in (("", samples), ("ceiling_", train)):
        ours, theirs = looped(rows, None), looped(held_out, weights)
        two_site = [
            [
                double[i, a, j, b] - single[i, a] * single[j, b]
                for i in range(SITES)
                for j in range(i + 1, SITES)
                for a in range(Q)
                for b in range(Q)
            ]
            for single, double in (ours, theirs)
        ]
        for name, (x, y) in (("one_site", (ours[0], theirs[0])), ("two_site", two_site)):
            x, y = np.ravel(x), np.ravel(y)
            assert found[f"{prefix}{name}_pearson"] == pytest.approx(np.corrcoef(x, y)[0, 1])
            assert found[f"{prefix}{name}_slope"] == pytest.approx(np.polyfit(y, x, 1)[0])
            assert found[f"{prefix}{name}_rms"] == pytest.approx(np.mean((x - y) ** 2) ** 0.5)
    assert len(found) == 12


def test_held_out_rows_are_their_own_best_samples():
    rows = np.random.default_rng(4).integers(Q, size=(50, SITES))
    found = compare(rows, rows, rows[:20], Q)
    assert found["two_site_pearson"] == pytest.approx(1)
    assert found["two_site_slope"] == pytest.approx(1)
    assert found["one_site_rms"] == found["two_site_rms"] == 0
    assert found["ceiling_two_site_pearson"] < 0.99


@pytest.mark.parametrize(
    ("rows", "weights", "message"),
    [
        ([[0, 4]], None, "0..4: expected 0..3"),
        ([[-1, 0]], None, "-1..0"),
        ([[0.0, 1.0]], None, "integers"),
        ([0, 1], None, "shape"),
        (np.zeros((0, 2), int), None, "not all 0"),
        ([[0, 1]], [1.0, 1.0], "expected (1,)"),
        ([[0, 1]], [-1.0], ">= 0"),
        ([[0, 1]], [0.0], "not all 0"),
        ([[0, 1]], [np.nan], "finite"),
    ],
)
def test_what_is_no_sequence_or_no_weight_is_refused(rows, weights, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(").replace(")", r"\)")):
        one_site(np.array(rows), Q, None if weights is None else np.array(weights))


def test_sets_of_different_numbers_of_sites_are_refused():
    rows = np.zeros((2, 3), int)
    with pytest.raises(ValueError, match="one number of sites"):
        compare(rows, rows[:, :2], rows, Q)


def test_files_for_foreign_environments_import_nothing_of_this_package():
    program = (
        f"import sys; sys.path.insert(0, {str(FOLDER)!r}); import site_statistics, peers; print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "peers" in done.stdout.split()
    assert not [name for name in done.stdout.split() if name.startswith(("memcomp_lightning", "torch", "rbms"))]
