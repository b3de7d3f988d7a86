"""Records, paired comparisons, and verdicts on made-up measurements whose answer is known."""

import json
from dataclasses import asdict

import numpy as np
import pytest
from scipy import stats

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.studies import Claim, FigurePlan, Record, Records, Results, markdown, page, verdicts
from memcomp_lightning.studies.comparison import compare
from memcomp_lightning.studies.page import Section
from memcomp_lightning.studies.results import at_best_validation
from memcomp_lightning.studies.verdicts import HOLDS, horizontal_arrow, vertical_arrow

CLAIM = Claim(better="mem", than="cd")


def noise(*shape, seed=0):
    """The same under every MEMCOMP_SEED: the verdicts are those of these very numbers."""
    stream = getattr(rng.stream, "__wrapped__", rng.stream)
    return rng.uniform(shape, generator=stream(seed, "noise")).numpy() - 0.5


def record(curve, accuracy, iterations=5, **settings):
    """One network of seven partitions, tested after 10 and 20 passes."""
    accuracy = np.broadcast_to(np.asarray(accuracy, float).T, (7, 2)).T
    made = {
        "method": curve,
        "iterations": iterations,
        "seed": 0,
        "at": [10, 20],
        "seconds": [2.0, 3.0],
        "measures": {"test_accuracy": accuracy.tolist()},
    }
    return Record(**{**made, **settings})


def plan(**settings):
    made = {
        "name": "figure4",
        "title": "made up",
        "data": "digits",
        "against": "iterations",
        "passes": [10, 20],
        "claims": [CLAIM],
        "labels": {"cd": "CD-1", "mem": "Mem-QUBO", "shuffled": "shuffled", "free": "no pretraining"},
        "chosen": {},
        "stop_early": [],
        "scale": "7 partitions",
    }
    return FigurePlan(**{**made, **settings})


def results(tmp_path, *found, **settings):
    tmp_path.mkdir(exist_ok=True)
    records = Records(tmp_path)
    records.append(found)
    return Results(plan(**settings), Records(tmp_path))


def test_comparison_is_the_paired_t_test():
    a, b = 0.7 + 0.1 * noise(11), 0.68 + 0.1 * noise(11, seed=1)
    found, expected = compare(a, b), stats.ttest_rel(a, b)
    interval = expected.confidence_interval(0.95)
    assert found[:4] == pytest.approx(((a - b).mean(), interval.low, interval.high, expected.pvalue))
    assert np.isnan(compare([0.7], [0.6]).p)
    assert compare([0.5, 0.6], [0.5, 0.6]).p == 1


def test_records_come_back_and_an_unfinished_line_is_dropped(tmp_path):
    first, second = record("cd", 0.3), record("mem", 0.4, value=0.5, choosing=True)
    Records(tmp_path).append([first, second])
    path = tmp_path / "records.jsonl"
    path.write_text(path.read_text() + '{"method": "me')
    assert Records(tmp_path).all == [first, second]
    assert len(path.read_text().splitlines()) == 2
    path.write_text("damaged\n" + path.read_text())
    with pytest.raises(SettingError, match="line 1"):
        Records(tmp_path)


def test_choice_is_made_by_held_out_images_alone(tmp_path):
    def tried(value, validation, test):
        scores = {"test_accuracy": [[test] * 7] * 2, "validation_accuracy": [[validation] * 7] * 2}
        return record("cd", test, value=value, choosing=True, measures=scores, held_out=validation)

    records = Records(tmp_path)
    records.append([tried(0.1, 0.5, 0.9), tried(0.2, 0.6, 0.1), record("cd", 0.3, value=0.1)])
    assert records.best_value("cd") == 0.2
    assert records.of("cd") == []  # the chosen value has not been trained yet
    records.append([record("cd", 0.4, value=0.2)])
    assert [r.measures["test_accuracy"][0][0] for r in records.of("cd")] == [0.4]


def test_early_stopping_takes_the_test_accuracy_at_the_best_validation_so_far():
    validation = [[0.5, 0.7], [0.8, 0.6], [0.6, 0.9]]
    test = [[0.1, 0.2], [0.3, 0.4], [0.5, 0.6]]
    found = record("bn", 0.0, measures={"test_accuracy": test, "validation_accuracy": validation})
    np.testing.assert_array_equal(at_best_validation(found), [[0.1, 0.2], [0.3, 0.2], [0.3, 0.6]])


def test_arrows_are_measured(tmp_path):
    spread = 0.01 * noise(7)
    found = results(
        tmp_path,
        *[
            record("cd", [[a + s for s in spread] for a in (0.30, 0.5)], n)
            for n, a in ((1, 0.2), (5, 0.3), (9, 0.3))
        ],
        *[record("mem", [[a + s for s in spread]] * 2, n) for n, a in ((1, 0.2), (5, 0.35), (9, 0.8))],
    )
    assert horizontal_arrow(found, CLAIM, 10) == (5, 9)
    assert vertical_arrow(found, CLAIM, 10).effect == pytest.approx(0.5)
    assert horizontal_arrow(found, CLAIM, 20) == (9, 9)


def test_gap_holds_only_without_the_control_that_reaches_it(tmp_path):
    base = 0.02 * noise(7)
    mem, cd = 0.8 + base, 0.3 + base + 0.01 * noise(7, seed=2)
    explained = mem - 0.01 + 0.005 * noise(7, seed=3)
    weak = cd + 0.1
    only_weak = results(
        tmp_path / "a", record("cd", [cd] * 2), record("mem", [mem] * 2), record("shuffled", [weak] * 2)
    )
    (gap, _) = verdicts(only_weak)  # a row for 10 and for 20 passes
    assert gap.verdict == HOLDS
    assert gap.test.startswith("+.5")
    both = results(
        tmp_path / "b",
        record("cd", [cd] * 2),
        record("mem", [mem] * 2),
        record("shuffled", [explained] * 2),
        record("free", [mem] * 2, iterations=0),
    )
    assert verdicts(both)[0][-2:] == ("holds only without controls", ("shuffled", "no pretraining"))
    swapped = results(tmp_path / "c", record("cd", [mem] * 2), record("mem", [cd] * 2))
    assert verdicts(swapped)[0].verdict == "does not hold"
    nothing = results(tmp_path / "d", record("cd", [mem] * 2), record("mem", [mem + 0.1 * noise(7, seed=4)] * 2))
    assert verdicts(nothing)[0].verdict == "does not hold"


def test_fewer_iterations_are_none_where_no_iteration_is_needed(tmp_path):
    def measured(folder, *more, first=0.8, cd_first=0.4):
        lengths = [record("mem", first, 1), record("mem", 0.8, 5), record("cd", cd_first, 1), record("cd", 0.5)]
        return verdicts(results(tmp_path / folder, *lengths, *more))[0]

    saved = measured("a")
    assert (saved.measured, saved.verdict) == ("N = 1 instead of 5 for 0.500", HOLDS)
    assert measured("b", first=0.3).verdict == "does not hold"  # N = 5, as the other one
    free = measured("c", record("free", 0.6, 0))
    assert free[-2:] == ("holds only without controls", ("no pretraining",))
    assert measured("d", record("free", 0.4, 0)).verdict == HOLDS
    useless = measured("e", cd_first=0.5)
    assert useless[1:4] == ("CD-1: 0.500 at N = 5, not significantly more than at N = 1", "", "does not hold")


def test_a_claim_has_controls_of_its_own(tmp_path):
    others = Claim(better="shuffled", than="free", controls=("cd",))
    made = plan(claims=[CLAIM, others])
    assert made.controls(others) == ["cd"]
    assert made.controls(CLAIM) == []
    assert plan().controls(CLAIM) == ["shuffled", "free"]


@pytest.mark.parametrize(("gain", "expected"), [(0.03, [HOLDS] * 3), (0.012, ["does not hold"] * 2 + [HOLDS])])
def test_claims_of_figure_6(tmp_path, gain, expected):
    bn = 0.9 + 0.01 * noise(7)
    mem = bn + gain + 0.02 * noise(7, seed=1)
    found = results(
        tmp_path,
        record("cd", [bn - 0.01, bn], 0),
        record("mem", [mem - 0.1, mem]),
        against="passes",
        name="figure6",
    )
    assert [verdict.verdict for verdict in verdicts(found)] == expected


def test_table_has_every_point(tmp_path):
    found = results(tmp_path, record("cd", 0.3), record("mem", [np.arange(7) / 10, np.ones(7)]))
    rows = found.table().splitlines()
    assert len(rows) == 5
    assert rows[3].startswith("mem,Mem-QUBO,5,10,0.3")
    assert float(rows[3].split(",")[5]) == pytest.approx(np.std(np.arange(7) / 10, ddof=1) / np.sqrt(7))


def test_page_and_markdown_escape_what_they_are_given(tmp_path):
    found = verdicts(results(tmp_path, record("cd", 0.3), record("mem", 0.4), labels={"cd": "<CD|1>", "mem": "M"}))
    html = page([Section("a < b", [("picture", b"png")], found, ["n & m"])])
    assert "&lt;CD|1&gt;" in html
    assert "a &lt; b" in html
    assert "<CD" not in html
    assert "cG5n" in html
    assert "<CD\\|1>" in markdown(found)


def test_plan_refuses_unknown_curves_and_axes():
    with pytest.raises(SettingError, match=r"figure\.claims = 'x'"):
        plan(claims=[Claim(better="x", than="cd")])
    with pytest.raises(SettingError, match=r"figure\.against = 'epochs'"):
        plan(against="epochs")
    assert FigurePlan.of(json.loads(json.dumps(asdict(plan())))) == plan()
