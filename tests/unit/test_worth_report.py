"""What is chosen, and by which replicas, on made-up courses."""

import numpy as np
import pytest

from memcomp_lightning import rng
from memcomp_lightning.studies.verdicts import FAILS, HOLDS
from memcomp_lightning.studies.worth import Course, Worth, holm, worth_table, worth_verdicts

PLAN = {
    "replicas": 11,
    "choosing": 3,
    "data_sets": {"bars": {"label": "bars", "measure": "kl"}},
    "methods": {name: {"label": name.upper()} for name in ("cd", "slow", "mode")},
    "claimed": ["mode"],
    "baselines": ["cd", "slow"],
}


def course(method, rate, reported, chosen=None, seconds=10.0):
    """Eleven replicas about one value, three others about another."""
    noise = 0.01 * (rng.uniform((14,), generator=rng.stream(0, "noise")).numpy() - 0.5)
    values = np.concatenate([np.full(11, reported), np.full(3, reported if chosen is None else chosen)]) + noise
    scores = [[1.0] * 14, values.tolist()]
    ones = [[1.0] * 14] * 2
    return Course("bars", method, rate, [1, 100], [0.1, seconds], scores, [], ones, ones)


def test_rates_are_chosen_by_the_replicas_that_are_not_reported():
    worth = Worth(PLAN, [course("cd", 0.1, 0.2, chosen=0.5), course("cd", 0.5, 0.4, chosen=0.3)])
    end = worth.end("bars", "cd")
    assert end.rate == 0.5
    assert end.median == pytest.approx(0.4, abs=0.01)
    assert end.worst == max(worth.best("bars", "cd").scores[-1][:11])


def test_the_opponent_takes_no_more_time():
    found = [course("cd", 0.1, 0.5, seconds=5), course("slow", 0.1, 0.1, seconds=50), course("mode", 0.1, 0.3)]
    worth = Worth(PLAN, found)
    assert worth.opponent("bars", "mode") == "cd"
    assert Worth(PLAN, [*found[:2], course("mode", 0.1, 0.3, seconds=49)]).opponent("bars", "mode") == "slow"
    assert Worth(PLAN, found[1:]).opponent("bars", "mode") == "slow"  # the quickest there is
    assert Worth(PLAN, found[2:]).opponent("bars", "mode") is None


@pytest.mark.parametrize(("mode", "expected"), [(0.3, HOLDS), (0.5, FAILS), (0.7, FAILS)])
def test_verdict(mode, expected):
    (verdict,) = worth_verdicts(Worth(PLAN, [course("cd", 0.1, 0.5), course("mode", 0.1, mode)]))
    assert verdict.verdict == expected
    assert verdict.claim == "bars: MODE beats CD"


def test_one_bad_replica_is_enough_to_lose():
    better = course("mode", 0.1, 0.3)
    better.scores[-1][4] = 0.9
    (verdict,) = worth_verdicts(Worth(PLAN, [course("cd", 0.1, 0.5), better]))
    assert verdict.verdict == FAILS
    assert "worst 0.9" in verdict.measured


def test_p_values_are_adjusted_for_their_number():
    assert holm([0.04, 0.001, 0.03]) == pytest.approx([0.06, 0.003, 0.06])
    assert holm([0.9, 0.6]) == [1.0, 1.0]


def test_table_has_a_row_for_each_method():
    rows = worth_table(Worth(PLAN, [course("cd", 0.1, 0.5), course("mode", 0.2, 0.3)]))
    assert [row[:4] for row in rows[1:]] == [["bars", "CD", "0.1", "0.1"], ["bars", "MODE", "0.2", "0.2"]]
    assert float(rows[1][-1]) == pytest.approx(10 * 1e6 / 100 / 14, abs=0.1)
