"""The solver benchmark's statistics."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "solver_benchmark"))
import measure
from measure import Tally


def test_tts99_is_the_time_after_which_one_read_in_a_hundred_batches_fails():
    success, seconds = 0.2, 3.0
    n_reads = measure.tts99(seconds, success) / seconds
    assert (1 - success) ** n_reads == pytest.approx(0.01)


def test_tts99_of_certain_success_is_one_read():
    assert measure.tts99(3.0, 1.0) == 3.0
    assert measure.tts99(3.0, 0.999) == 3.0


def test_tts99_without_success_is_infinite_and_estimated_by_a_bound():
    assert measure.tts99(3.0, 0.0) == np.inf
    values, censored = measure.estimate([Tally(1.0, 0, 300), Tally(1.0, 300, 300)])
    assert censored.tolist() == [True, False]
    assert values.tolist() == pytest.approx([np.log(0.01) / np.log(0.99), 1.0])


def test_tally_counts_within_a_relative_millionth():
    energies = [-1000.0, -1000.0 + 5e-4, -1000.0 + 2e-3, -999.0]
    assert measure.tally(energies, 2.0, -1000.0) == Tally(0.5, 2, 4)


def test_ranking_prefers_a_success_to_none_at_equal_time():
    assert measure.ranking([Tally(0.01, 1, 100)]) < measure.ranking([Tally(0.1, 0, 10)])
    assert measure.ranking([Tally(0.01, 1, 100)]) < measure.ranking([Tally(0.01, 0, 100)]) < np.inf


def test_bootstrap_interval_covers_the_truth():
    generator, covered = np.random.default_rng(1), 0
    for _ in range(100):
        tally = Tally(1.0, int(generator.binomial(200, 0.1)), 200)
        interval = measure.family_tts([tally])
        covered += interval.low <= measure.tts99(1.0, 0.1) <= interval.high
    assert 88 <= covered <= 100


def test_ratio_of_solvers_pairs_the_instances():
    hard_and_easy = [(0.01, 0.5), (0.5, 0.9), (0.02, 0.6), (0.3, 0.8)]
    one = [Tally(1e-3, int(1e5 * p), 10**5) for p, _ in hard_and_easy]
    other = [Tally(2e-3, int(1e5 * p), 10**5) for p, _ in hard_and_easy]
    ratio = measure.family_ratio(other, one)
    assert ratio.value == pytest.approx(2.0)
    assert 1.9 < ratio.low < 2.0 < ratio.high < 2.1


def test_bounds_are_marked():
    solved, unsolved = [Tally(1.0, 5, 10)], [Tally(1.0, 0, 10)]
    assert [measure.family_tts(tallies).mark for tallies in (solved, unsolved)] == ["", ">"]
    ratios = [measure.family_ratio(a, b).mark for a in (solved, unsolved) for b in (solved, unsolved)]
    assert ratios == ["", "<", ">", "><"]


def test_expected_gap_is_the_mean_of_the_best_of_k():
    energies, generator = [-10.0, -9.0, -8.0, -5.0], np.random.default_rng(0)
    drawn = generator.choice(energies, size=(100_000, 3)).min(1)
    assert measure.expected_gap(energies, 4.0, -10.0, 3.5) == pytest.approx((drawn.mean() + 10) / 10, abs=5e-3)
    assert np.isnan(measure.expected_gap(energies, 4.0, -10.0, 0.5))


@pytest.mark.parametrize(
    ("power", "law"), [(True, lambda n: 1e-6 * n**2.5), (False, lambda n: 1e-3 * np.exp(0.03 * n))]
)
def test_scaling_finds_the_exponent(power, law):
    sizes = [50, 100, 200, 400] if power else [50, 75, 100, 150]
    tallies = [[Tally(float(law(n)), 1000, 1000)] * 3 for n in sizes]
    fit = measure.scaling(sizes, tallies, power=power)
    assert fit.slope.value == pytest.approx(2.5 if power else 0.03, rel=1e-6)
    assert fit.slope.low * 0.98 <= fit.slope.value <= fit.slope.high * 1.02


def test_store_resumes_and_survives_a_line_cut_off(tmp_path):
    pytest.importorskip("dwave.samplers")
    from sweep import Store

    path, runs = tmp_path / "rows.jsonl", []
    row = {"digest": "a", "budget": 1}
    Store(path).get(row, lambda: runs.append(1) or {"energies": [2.0, -3.0]})
    with path.open("a") as file:
        file.write('{"key": "cut o')
    store = Store(path)
    assert store.get(row, lambda: runs.append(1))["energies"] == [2.0, -3.0]
    store.get({**row, "budget": 2}, lambda: runs.append(1) or {"energies": [0.0]})
    assert len(runs) == 2
    assert store.lowest("a", known=-1.0) == -3.0
    assert [json.loads(line)["budget"] for line in path.read_text().splitlines() if line.endswith("}")] == [1, 2]
