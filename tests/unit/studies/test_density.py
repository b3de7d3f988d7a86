"""A comparison of density models: its search, its peers, its numbers and verdicts."""

import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.models import RBM
from memcomp_lightning.studies.density import Densities, Density, Model, Peer, PeerTrial, peers_of
from memcomp_lightning.studies.density.plot import density_figures
from memcomp_lightning.studies.density.results import density_table, density_verdicts
from memcomp_lightning.studies.density.trial import scores_of
from memcomp_lightning.studies.records import Record
from memcomp_lightning.studies.search import best_of, checked_start, missing, text_of

PROGRAM = """
import json, pathlib, sys
if sys.argv[1] == "--list":
    coin = {"label": "a coin", "axes": {"bias": [1, 2]}, "start": {"bias": 1}, "missing": None}
    print(json.dumps({"coin": coin}))
    sys.exit()
given = dict(zip(sys.argv[2::2], sys.argv[3::2]))
bias = json.loads(given["--settings"])["bias"]
if bias == 2:
    sys.exit("a bias of 2 is too much")
answer = {"valid": -bias, "test": -2 * bias, "seconds": 0.5}
pathlib.Path(given["--out"]).write_text(json.dumps(answer))
"""


def density(**settings: object) -> Density:
    common: dict[str, object] = {
        "name": "density",
        "title": "tables",
        "folder": None,
        "tables": ["t"],
        "only": None,
        "replicas": 2,
        "peer_replicas": 1,
        "points": 3,
        "patience": 2,
        "quick_betas": 10,
        "betas": 20,
        "chains": 10,
        "overrides": [],
        "axes": {"rate": [1, 2]},
        "start": {"rate": 1, "updates": 5},
        "models": {name: Model(label=name.upper(), overrides=[]) for name in ("cd1", "pcd", "mode")},
        "baselines": ["cd1", "pcd"],
        "peers": None,
        "peers_python": None,
        "workers": 1,
    }
    return Density(**{**common, **settings})  # type: ignore[arg-type]


def test_a_search_walks_uphill_on_each_axis_and_is_taken_up_anywhere() -> None:
    axes, start = {"a": [0, 1, 2, 3, 4], "b": [0, 1, 2]}, {"a": 1, "b": 0, "updates": 7}

    def value(setting: dict[str, int]) -> float:
        return -((setting["a"] - 3) ** 2) - (setting["b"] - 1) ** 2

    judged: dict[str, float] = {}
    while asked := missing(axes, start, judged):
        setting = asked[0]  # one at a time: what is asked next depends on what is known alone
        judged[text_of(setting)] = value(setting)
    assert best_of(axes, start, judged) == {"a": 3, "b": 1, "updates": 7}
    assert len(judged) == 9  # 1, 0, 2, 3 and 4 of a; 1 and 2 of b; in the second round 2 and 4 of a
    assert missing(axes, start, {}) == [{**start, "a": a} for a in (0, 1, 2)]


def test_axes_that_want_each_other_changed_are_climbed_in_rounds() -> None:
    axes, start = {"rate": [0, 1, 2, 3, 4], "hidden": [0, 1, 2, 3, 4]}, {"rate": 0, "hidden": 0}
    judged = {
        text_of({"rate": rate, "hidden": hidden}): -0.4 * (rate - hidden) ** 2 + rate + 2 * hidden
        for rate in axes["rate"]
        for hidden in axes["hidden"]
    }
    # The first round ends at rate 1 and 3 hidden units: more of them pay for a higher rate, which the next takes.
    assert best_of(axes, start, judged) == {"rate": 4, "hidden": 4}


def test_a_setting_that_diverged_is_not_chosen() -> None:
    axes, start = {"a": [0, 1]}, {"a": 0}
    judged = {text_of({"a": 0}): -5.0, text_of({"a": 1}): -math.inf}
    assert best_of(axes, start, judged) == {"a": 0}


def test_a_whole_number_is_a_value_of_an_axis_of_real_ones() -> None:
    axes = {"rate": [0.5, 1.0]}
    start = checked_start(axes, {"rate": 1, "updates": 7}, "m")
    assert [text_of(setting) for setting in missing(axes, start, {})] == [
        text_of({"rate": rate, "updates": 7}) for rate in (0.5, 1.0)
    ]
    assert missing(axes, start, {text_of({"rate": rate, "updates": 7}): rate for rate in (0.5, 1.0)}) == []


def test_a_start_that_is_no_value_of_its_axis_is_refused() -> None:
    with pytest.raises(SettingError, match=r"m: axis rate = \[1, 2\] is not allowed: .*the start, 3"):
        checked_start({"rate": [1, 2]}, {"rate": 3}, "m")
    with pytest.raises(SettingError, match=r"updates"):
        density(start={"rate": 1})


def test_peers_are_asked_and_fitted_by_their_program(tmp_path: Path) -> None:
    program = tmp_path / "peers.py"
    program.write_text(PROGRAM)
    peers = peers_of(sys.executable, str(program))
    assert peers == {"coin": Peer(label="a coin", axes={"bias": [1, 2]}, start={"bias": 1})}
    trial = PeerTrial(
        method="coin",
        data_set="t",
        setting='{"bias": 1}',
        seed=0,
        choosing=True,
        python=sys.executable,
        program=str(program),
        files=("a", "b", "c"),
        betas=10,
        chains=10,
    )
    (chosen_by,) = trial.run(lambda what, n: None)
    assert chosen_by.held_out == -1
    assert "test" not in chosen_by.measures
    (reported,) = replace(trial, choosing=False).run(lambda what, n: None)
    assert reported.measures["test"] == [[-2.0]]
    assert reported.seconds == [0.5]
    failing = replace(trial, setting='{"bias": 2}')
    (left_out,) = failing.run(lambda what, n: None)
    assert left_out.held_out == -math.inf
    with pytest.raises(UserError, match=r"peers.py coin: a bias of 2 is too much"):
        replace(failing, choosing=False).run(lambda what, n: None)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("print('[]')", "gave no JSON of peers"),
        ("print('nothing')", "gave no JSON of peers"),
        ("import sys; sys.exit('broken')", "broken"),
        (
            'print(\'{"a": {"label": "a", "axes": {}, "start": {}, "missing": "pip install a"}}\')',
            "nothing that its peers need is installed. a: pip install a",
        ),
    ],
)
def test_a_program_that_is_no_program_of_peers_is_refused(tmp_path: Path, text: str, said: str) -> None:
    program = tmp_path / "peers.py"
    program.write_text(text)
    with pytest.raises(UserError, match=said):
        peers_of(sys.executable, str(program))
    with pytest.raises(UserError, match=r"density\.peers_python=no-python"):
        peers_of("no-python", str(program))


def record(method: str, test: list[float], reverse: list[float] | None = None, **settings: object) -> Record:
    measures = {
        "valid": [[-3.0] * len(test), [-1.0] * len(test)],
        "test": [test],
        "test_reverse": [reverse or test],
    }
    measures |= {"standard_error": [[0.1] * len(test)], "valid_best": [[-1.0] * len(test)]}
    measures |= {"train": [[-2.0] * len(test), [-0.5] * len(test)], "independent": [[-9.0] * len(test)]}
    values = {"seconds": [1.0, 2.0], "setting": '{"rate": 1}', **settings}
    return Record(method=method, data_set="t", at=[1, 2], measures=measures, **values)  # type: ignore[arg-type]


def test_what_is_reported_is_the_lower_estimate_and_no_number_where_they_disagree() -> None:
    records = [record("cd1", [-5.0, -5.2], [-5.1, -5.1]), record("pcd", [-4.0, -4.0], [-5.5, -4.0])]
    results = Densities(density(), {}, records)
    found = results.of("t")
    assert found["cd1"].test.tolist() == [-5.1, -5.2]
    assert found["cd1"].known
    assert not found["pcd"].known
    assert found["cd1"].seconds == 1.0  # of two seeds side by side
    assert found["cd1"].train == -0.5  # after the pass that held-out rows liked best
    assert results.best_model("t") == "cd1"
    rows = {row[1]: row[2] for row in density_table(results)}
    assert rows["PCD"] == "not known"
    assert rows["independent bits"] == "-9.000"
    assert set(density_figures(results)) == {"density", "density_t"}


def test_training_rows_are_those_of_the_weights_that_each_seed_keeps() -> None:
    own = record("cd1", [-5.0, -5.0])
    own.measures["valid"] = [[-1.0, -9.0], [-math.inf, -2.0]]
    own.measures["train"] = [[-0.5, -8.0], [math.nan, -1.5]]
    assert Densities(density(), {}, [own]).of("t")["cd1"].train == -1.0


def test_a_table_keeps_its_letters_and_lacks_what_is_unknown() -> None:
    own = replace(record("cd1", [-5.0]), data_set="finance")
    rows = density_table(Densities(density(tables=["finance"]), {}, [own]))
    assert [row[:4] for row in rows[1:]] == [
        ["finance", "independent bits", "-9.000", ""],
        ["finance", "CD1", "-5.000", ""],
    ]


def test_verdicts_count_peers_and_correct_for_the_number_of_lines() -> None:
    plan = density(replicas=3)
    peers = {name: Peer(label=name, axes={}, start={}) for name in ("worse", "better")}
    records = [
        record("cd1", [-5.0, -5.1, -5.2], seconds=[1.0, 6.0]),
        record("pcd", [-4.0, -4.1, -4.2], seconds=[1.0, 9.0]),  # too slow to stand against mode
        record("mode", [-4.5, -4.6, -4.7], seconds=[1.0, 6.3]),
        record("worse", [-6.0]),
        record("better", [-3.0]),
    ]
    lines = density_verdicts(Densities(plan, peers, records))
    by_claim = {line.claim: line for line in lines}
    against_peers = next(line for line in lines if "ahead" in line.claim)
    assert against_peers.test == "place 2 of 3; -2.100, too few seeds: no test"
    assert against_peers.verdict == "does not hold"
    assert by_claim["t: MODE beats CD1"].verdict == "holds"
    # A second line of the same strength doubles the smaller p value.
    alone = float(by_claim["t: MODE beats CD1"].test.rpartition("p = ")[2])
    more = density(replicas=3, models={**plan.models, "other": Model(label="OTHER", overrides=[])})
    twice = density_verdicts(
        Densities(more, peers, [*records, record("other", [-4.5, -4.6, -4.7], seconds=[1.0, 6.3])])
    )
    assert float(twice[1].test.rpartition("p = ")[2]) == pytest.approx(2 * alone, rel=0.1)


@pytest.mark.parametrize(("best_peer", "verdict"), [(-6.0, "holds"), (-5.11, "does not hold")])
def test_a_model_is_ahead_where_seeds_do_not_explain_it(best_peer: float, verdict: str) -> None:
    peers = {"coin": Peer(label="coin", axes={}, start={})}
    peer = [record("coin", [best_peer], setting='{"bias": 1}') for _ in range(3)]
    (line,) = density_verdicts(Densities(density(replicas=3), peers, [record("cd1", [-5.0, -5.1, -5.2]), *peer]))
    assert line.test.startswith("place 1 of 2; ")
    assert line.verdict == verdict


def test_scores_are_exact_where_a_layer_is_small() -> None:
    rbm = RBM(3, 2)
    v = torch.tensor([[0.0, 1.0, 1.0], [1.0, 1.0, 0.0]])
    (scores,) = scores_of(rbm, v, [v], 10, 10)
    states = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3)
    with torch.no_grad():
        log_z = (-rbm.free_energy(states)).logsumexp(0)
        mean = float((-rbm.free_energy(v) - log_z).mean())
    assert scores.up.item() == pytest.approx(mean, abs=1e-5)
    assert scores.least.equal(scores.up)


def test_settings_survive_the_file_of_the_run(tmp_path: Path) -> None:
    from dataclasses import asdict

    from memcomp_lightning.studies.density import read_densities

    peers = {"coin": asdict(Peer(label="a coin", axes={"bias": [1, 2]}, start={"bias": 1}))}
    (tmp_path / "density.json").write_text(json.dumps({**asdict(density()), "found_peers": peers}))
    read = read_densities(tmp_path)
    assert read.plan == density()
    assert read.label("coin") == "a coin"
    with pytest.raises(FileNotFoundError, match=r"no density\.json"):
        read_densities(tmp_path / "nothing")
