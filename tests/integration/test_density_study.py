"""``experiment=density`` in small: the search, a peer, resume, report, and what is refused."""

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from running import Outcome
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from memcomp_lightning.studies import Record, Records

pytest.importorskip("pyarrow")

Run = Callable[..., Outcome]
COIN = """
import json, pathlib, sys
if sys.argv[1] == "--list":
    coin = {"label": "a coin", "axes": {"bias": [1, 2]}, "start": {"bias": 1}, "missing": None}
    print(json.dumps({"coin": coin}))
    sys.exit()
given = dict(zip(sys.argv[2::2], sys.argv[3::2]))
bias = json.loads(given["--settings"])["bias"]
pathlib.Path(given["--out"]).write_text(json.dumps({"valid": bias - 9.0, "test": bias - 9.5, "seconds": 0.5}))
"""
SMALL = [
    "experiment=density",
    "density.folder=tables",
    "density.tables=[small]",
    "density.only=[cd1,mode_cd,coin]",
    "density.axes={rate: [0.1, 0.2], l2: [0.001], hidden: [3], updates: [20]}",
    "density.start={rate: 0.1, l2: 0.001, hidden: 3, updates: 20}",
    "density.replicas=2",
    "density.peer_replicas=1",
    "density.points=3",
    "density.workers=1",
    "density.peers=coin.py",
    "pretrain.batch_size=20",
    "hydra.run.dir=run",
]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a small table of which a column never changes in the training rows, and a peer."""
    monkeypatch.chdir(tmp_path)
    Path("tables").mkdir()
    draws = np.random.default_rng(0)
    for part, n in (("train", 60), ("valid", 20), ("test", 30)):
        rows = draws.integers(0, 2, (n, 5))
        rows[:, 3] = rows[:, 0]
        rows[:, 4] = part == "test"
        np.savetxt(f"tables/small.{part}.csv", rows, fmt="%d", delimiter=",")
    Path("coin.py").write_text(COIN)
    return tmp_path


def records() -> list[Record]:
    return Records(Path("run")).all


def test_settings_are_searched_and_reported_once_and_a_run_goes_on(memcomp_train: Run, here: Path) -> None:
    outcome = memcomp_train(*SMALL)
    assert outcome.status == 0, outcome.err
    found = records()
    choosing = [record for record in found if record.choosing]
    assert {(record.method, record.setting) for record in choosing} == {
        *(
            (name, json.dumps({"hidden": 3, "l2": 0.001, "rate": r, "updates": 20}))
            for name in ("cd1", "mode_cd")
            for r in (0.1, 0.2)
        ),
        ("coin", '{"bias": 1}'),
        ("coin", '{"bias": 2}'),
    }
    assert all("test" not in record.measures for record in choosing)
    reported = {record.method: record for record in found if not record.choosing}
    assert set(reported) == {"cd1", "mode_cd", "coin"}
    assert reported["coin"].measures["test"] == [[-7.5]]  # of the bias that is better on held-out rows
    for name in ("cd1", "mode_cd"):
        best = max((record.held_out, record.setting) for record in choosing if record.method == name)
        assert reported[name].setting == best[1]
        assert len(reported[name].measures["test"][0]) == 2
        assert reported[name].at[-1] == 21  # twenty updates are seven passes of three
    assert "CD-1 is ahead of all peers" in outcome.out or "annealing" in outcome.out or "DMM" in outcome.out
    for name in ("density.png", "density_small.png", "density.csv", "verdicts.md", "report.html"):
        assert Path("run", name).stat().st_size > 0

    events = EventAccumulator("run/tensorboard/RBM, CD-1").Reload()
    assert [event.step for event in events.Scalars("small/held-out")] == reported["cd1"].at
    assert "small/test" in events.Tags()["scalars"]

    path = Path("run/records.jsonl")
    path.write_text("".join(line + "\n" for line in path.read_text().splitlines()[:-1]))
    assert memcomp_train("resume=run", "trusted=[coin.py]").status == 0
    again = records()
    assert {record.key for record in again} == {record.key for record in found}
    assert len(again) == len(found)


def test_what_fits_nowhere_is_left_out_and_the_others_are_reported(memcomp_train: Run, here: Path) -> None:
    Path("coin.py").write_text(COIN.replace("bias = json", "sys.exit('no bias fits')\nbias = json"))
    outcome = memcomp_train(*(o for o in SMALL if "only" not in o), "density.only=[cd1,coin]")
    assert outcome.status == 0, outcome.err
    assert {record.method for record in records() if not record.choosing} == {"cd1"}
    assert {record.held_out for record in records() if record.method == "coin"} == {-math.inf}
    assert "no bias fits" in Path("run/train.log").read_text()


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("density.tables=[nothing]", "tables holds no nothing.train.csv.gz or nothing.train.csv"),
        ("density.only=[cd2]", "density.only = 'cd2' is not allowed"),
        ("density.replicas=0", "density.replicas = 0"),
        ("density.models.cd1.overrides=['model.hidden_sizes=[{width}]']", "setting = 'width' is not allowed"),
        ("pretrain.iterations=5", "Use density.start.updates"),
        ("pretrain.updates=5", "Use density.start.updates"),
        ("model.hidden_sizes=[5]", "Use density.start.hidden"),
        ("data=table", "Use density.folder"),
        ("data.partitions=2", "data.partitions = (2,)"),
        ("sampler=cd", "Each of density.models has its own"),
        ("density.peers=nothing.py", "nothing.py"),
        ("density.models.cd1.overrides=['model.hidden_sizes=[3,3]']", "trained with pretrain=joint"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_trains(
    memcomp_train: Run, here: Path, typed: str, said: str
) -> None:
    outcome = memcomp_train(*(o for o in SMALL if o.split("=")[0] != typed.split("=")[0]), typed)
    assert outcome.status != 0
    assert said in outcome.err
    assert not Path("run/records.jsonl").exists()
