"""What is chosen, and by which replicas, on made-up records."""

import numpy as np
import pytest

from memcomp_lightning import rng
from memcomp_lightning.studies import Record
from memcomp_lightning.studies.verdicts import FAILS, HOLDS
from memcomp_lightning.studies.worth import Comparison, DataSet, Method, Worth, holm, worth_table, worth_verdicts

PLAN = Comparison(
    name="worth",
    title="made up",
    replicas=11,
    choosing=3,
    rates=[0.1],
    points=2,
    gradient_draws=1,
    only=None,
    data_sets={"bars": DataSet(label="bars", overrides=[], passes=100, measure="kl")},
    methods={name: Method(label=name.upper(), overrides=[]) for name in ("cd", "slow", "mode")},
    claimed=["mode"],
    baselines=["cd", "slow"],
    workers=1,
)


def record(method, rate, reported, chosen=None, seconds=10.0):
    """Eleven replicas about one value, three others about another."""
    noise = 0.01 * (rng.uniform((14,), generator=rng.stream(0, "noise")).numpy() - 0.5)
    values = np.concatenate([np.full(11, reported), np.full(3, reported if chosen is None else chosen)]) + noise
    measures = {"score": [[1.0] * 14, values.tolist()]}
    judged = -float(np.median(values[11:]))
    settings = {"data_set": "bars", "method": method, "value": rate, "held_out": judged}
    return Record(at=[1, 100], seconds=[0.1, seconds], measures=measures, **settings)


def test_rates_are_chosen_by_the_replicas_that_are_not_reported():
    worth = Worth(PLAN, [record("cd", 0.1, 0.2, chosen=0.5), record("cd", 0.5, 0.4, chosen=0.3)])
    end = worth.end("bars", "cd")
    assert end.rate == 0.5
    assert end.median == pytest.approx(0.4, abs=0.01)
    assert end.worst == max(worth.best("bars", "cd").measures["score"][-1][:11])


def test_the_opponent_takes_no_more_time():
    found = [record("cd", 0.1, 0.5, seconds=5), record("slow", 0.1, 0.1, seconds=50), record("mode", 0.1, 0.3)]
    worth = Worth(PLAN, found)
    assert worth.opponent("bars", "mode") == "cd"
    assert Worth(PLAN, [*found[:2], record("mode", 0.1, 0.3, seconds=49)]).opponent("bars", "mode") == "slow"
    assert Worth(PLAN, found[1:]).opponent("bars", "mode") == "slow"  # the quickest there is
    assert Worth(PLAN, found[2:]).opponent("bars", "mode") is None


@pytest.mark.parametrize(("mode", "expected"), [(0.3, HOLDS), (0.5, FAILS), (0.7, FAILS)])
def test_verdict(mode, expected):
    (verdict,) = worth_verdicts(Worth(PLAN, [record("cd", 0.1, 0.5), record("mode", 0.1, mode)]))
    assert verdict.verdict == expected
    assert verdict.claim == "bars: MODE beats CD"


def test_one_bad_replica_is_enough_to_lose():
    better = record("mode", 0.1, 0.3)
    better.measures["score"][-1][4] = 0.9
    (verdict,) = worth_verdicts(Worth(PLAN, [record("cd", 0.1, 0.5), better]))
    assert verdict.verdict == FAILS
    assert "worst 0.9" in verdict.measured


def test_p_values_are_adjusted_for_their_number():
    assert holm([0.04, 0.001, 0.03]) == pytest.approx([0.06, 0.003, 0.06])
    assert holm([0.9, 0.6]) == [1.0, 1.0]


def test_table_has_a_row_for_each_method():
    rows = worth_table(Worth(PLAN, [record("cd", 0.1, 0.5), record("mode", 0.2, 0.3)]))
    assert [row[:4] for row in rows[1:]] == [["bars", "CD", "0.1", "0.1"], ["bars", "MODE", "0.2", "0.2"]]
    assert float(rows[1][-1]) == pytest.approx(10 * 1e6 / 100 / 14, abs=0.1)
