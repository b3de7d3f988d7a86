"""``continue=FOLDER``: a new run that goes on from the weights and the chains of a finished one."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from running import QUIET, Outcome

Run = Callable[..., Outcome]
BARS = [*QUIET, "data=shifting_bars", "data.source.copies=3", "sampler=pcd", "sampler.n_chains=7", "seed=3"]
ONE = [*BARS, "model=one_layer", "model.hidden_sizes=[5]", "finetune.iterations=0"]
WHOLE = [*ONE, "pretrain.batch_size=null"]
"""All images an update: no order that could differ."""
SEEN = "may be among those that"
CENTRED = "pretrain.centring={_target_:memcomp_lightning.objective.Centring,rate:0.05}"


def found(folder: str, name: str = "result.json") -> Any:
    return json.loads(Path(folder, name).read_text())


def weights(folder: str, stage: str = "pretrain") -> dict[str, torch.Tensor]:
    return dict(torch.load(Path(folder, "weights", f"{stage}.pt"), weights_only=True))


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(x.equal(other[name]) for name, x in one.items())


def done(outcome: Outcome) -> str:
    assert outcome.status == 0, outcome.err
    return outcome.out + outcome.err


def contents(folder: str) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


@pytest.fixture
def first(memcomp_train: Run) -> None:
    done(memcomp_train(*ONE, "pretrain=greedy", "pretrain.iterations=1", "hydra.run.dir=first"))


def test_more_passes_are_those_of_the_longer_run(memcomp_train: Run) -> None:
    name, joint = "jointly", ["pretrain=joint", CENTRED]  # unit/modules/test_kept_chains.py: one layer
    done(memcomp_train(*WHOLE, *joint, "pretrain.iterations=5", "hydra.run.dir=long"))
    done(memcomp_train(*WHOLE, *joint, "pretrain.iterations=3", "hydra.run.dir=short"))
    before = contents("short")
    said = done(memcomp_train("continue=short", "pretrain.iterations=2", "hydra.run.dir=more"))
    assert same(weights("more"), weights("long"))
    assert contents("short") == before
    assert f"The chains of {name} are kept." in said
    assert SEEN not in said
    assert f"Passes in all: pretrain {name} 5" in said
    short = str(Path("short").absolute())
    history = found("more", "history.json")["runs"]
    assert [run["run"] for run in history] == [short]
    assert history[0]["settings"]["pretrain"]["iterations"] == 3
    assert found("more")["history"] == [{"run": short, "passes": {"pretrain": {name: 3}}}]
    assert found("more")["total_passes"] == {"pretrain": {name: 5}}


def test_each_layer_goes_on_and_fine_tuning_begins_anew(memcomp_train: Run) -> None:
    two = [*BARS, "model.hidden_sizes=[5,4]", "pretrain.iterations=2", "finetune.iterations=3"]
    done(memcomp_train(*two, "hydra.run.dir=first"))
    still = ["pretrain.optimizer.lr=1e-30", "pretrain.iterations=1"]  # no step is larger than rounding
    said = done(memcomp_train("continue=first", *still, "seed=4", "hydra.run.dir=second"))
    assert same(weights("second"), weights("first"))
    assert said.count("are kept.") == 2
    assert "pretrain layer 1 3, pretrain layer 2 3, finetune 3" in said
    # Without more pretraining, fine-tuning goes on from where it was.
    tuned = ["pretrain.iterations=0", "finetune.optimizer.lr=1e-30", "finetune.iterations=2"]
    said = done(memcomp_train("continue=second", *tuned, "hydra.run.dir=third"))
    assert same(weights("third", "finetune"), weights("second", "finetune"))
    assert "pretrain layer 1 3, pretrain layer 2 3, finetune 5" in said
    assert [Path(run["run"]).name for run in found("third")["history"]] == ["first", "second"]


@pytest.mark.usefixtures("first")
def test_chains_are_kept_where_they_fit(memcomp_train: Run) -> None:
    for number, (changed, said) in enumerate(
        {
            "sampler=cd": "begin anew, because they were of PCD and are of CD",
            "pretrain=joint": "begin anew, because none were kept",
        }.items()
    ):
        output = done(memcomp_train("continue=first", changed, f"hydra.run.dir=next_{number}"))
        assert f" {said}." in output
        assert list(found(f"next_{number}")["stages"]["pretrain"]["chains"].values()) == [said]


def test_another_option_of_a_group_leaves_its_settings_behind(memcomp_train: Run) -> None:
    done(memcomp_train(*ONE, "pretrain.iterations=1", "pretrain.optimizer.lr=0.3", "hydra.run.dir=first"))
    done(memcomp_train("continue=first", "sampler=cd", "sampler.k=2", "hydra.run.dir=second"))
    overrides = found("second", "overrides.json")["overrides"]
    assert "sampler.n_chains=7" not in overrides
    assert "sampler=pcd" not in overrides
    assert "pretrain.optimizer.lr=0.3" in overrides
    # A run that goes on from one that went on keeps both in its history.
    done(memcomp_train("continue=second", "hydra.run.dir=third"))
    assert sum(o.startswith("continue=") for o in found("third", "overrides.json")["overrides"]) == 1
    assert found("third")["total_passes"] == {"pretrain": {"layer 1": 3}}


def test_a_sweep_and_an_interruption(memcomp_train: Run) -> None:
    done(memcomp_train(*ONE, "pretrain.iterations=2", "hydra.run.dir=first"))
    more = ["continue=first", "pretrain.iterations=1"]
    done(memcomp_train("-m", *more, "pretrain.optimizer.lr=0.1", "hydra.sweep.dir=sweep"))
    jobs = sorted(path for path in Path("sweep").iterdir() if path.is_dir())
    assert [found(str(job))["total_passes"]["pretrain"]["layer 1"] for job in jobs] == [3]
    # Killed before it had written anything but its settings:
    kept = weights(str(jobs[0]))
    shutil.rmtree(jobs[0] / "weights")
    for name in ("result.json", "stages.json"):
        (jobs[0] / name).unlink()
    done(memcomp_train(f"resume='{jobs[0]}'"))
    assert same(weights(str(jobs[0])), kept)


def test_a_value_that_was_chosen_stays(memcomp_train: Run) -> None:
    choose = "choose={setting:pretrain.optimizer.lr,values:[0.1,0.2]}"
    small = ["finetune.iterations=1", "pretrain.iterations=1", choose]
    done(memcomp_train(*ONE, "data.source.copies=9", *small, "hydra.run.dir=first"))
    chosen = found("first")["choice"]["value"]
    done(memcomp_train("continue=first", "hydra.run.dir=second"))
    overrides = found("second", "overrides.json")["overrides"]
    assert f"pretrain.optimizer.lr={chosen}" in overrides
    assert "choice" not in found("second")


def test_new_rows_of_the_same_columns_are_read_as_the_old_ones(memcomp_train: Run) -> None:
    def table(name: str, header: str, shift: float, words: str) -> None:
        lines = [f"{k % 7 + shift},{words[k % len(words)]}" for k in range(40)]
        Path(name).write_text("\n".join([header, *lines]) + "\n")

    table("old.csv", "size,kind", 0.5, "abc")
    table("new.csv", "size,kind", 2.25, "ab")
    table("unknown.csv", "size,kind", 0.5, "abd")
    table("other.csv", "weight,kind", 0.5, "abc")
    small = [*QUIET, "data=table", "data.path=old.csv", "pretrain.iterations=1", "pretrain.batch_size=null"]
    done(memcomp_train(*small, "hydra.run.dir=first"))
    said = done(memcomp_train("continue=first", "data.path=new.csv", "hydra.run.dir=second"))
    before_training_and_after = said.count(f"The test rows {SEEN} {Path.cwd()}/first was trained on")
    assert before_training_and_after == 2
    assert SEEN in done(memcomp_train("continue=second", "hydra.run.dir=again"))  # by the first of the two
    assert found("second", "schema.json") == found("first", "schema.json")
    for settings, message in (
        (["data.path=other.csv"], "other.csv has no column 'size'"),
        (["data.path=unknown.csv"], "unknown.csv, column 'kind', row 3: 'd'"),
        (["data.columns={size: category}"], "data.columns = {'size': 'category'} is not allowed: expected None"),
        (["data=shifting_bars", "model.hidden_sizes=[128]", "units=bernoulli"], "units"),
    ):
        outcome = memcomp_train("continue=first", *settings, "hydra.run.dir=third")
        assert outcome.status != 0
        assert message in outcome.err
        assert not Path("third").exists()


@pytest.mark.usefixtures("first")
def test_what_cannot_be_gone_on_from_is_refused(memcomp_train: Run) -> None:
    baseline = [*BARS, "control=bn_relu", "model.hidden_sizes=[5]", "pretrain.iterations=0"]
    done(memcomp_train(*baseline, "finetune.iterations=1", "hydra.run.dir=tuned"))
    shutil.copytree("first", "unfinished")
    Path("unfinished/result.json").unlink()
    Path("empty").mkdir()
    here = Path.cwd()
    for arguments, message in (
        (["continue="], "continue= names no folder"),
        (["continue=empty"], f"continue={here}/empty: there is no overrides.json"),
        (["continue=unfinished"], f"Finish it: memcomp-train resume={here}/unfinished"),
        (
            ["continue=first", "model.hidden_sizes=[6]"],
            "model.hidden_sizes = [6] is not allowed: expected [5]",
        ),
        (["continue=first", "units=spin"], "units"),
        (["continue=first", "data.partitions=2"], "data.partitions = 2 is not allowed: expected 1"),
        (["continue=first", "data.source.n_pixels=8"], "lack 0,8"),
        (["continue=first", "model.weights=first/weights/pretrain.pt"], "null with continue=FOLDER"),
        (["continue=first", "choose={setting:pretrain.optimizer.lr,values:[1]}"], "choose"),
        (["continue=tuned", "pretrain.iterations=1"], "pretrained nothing"),
        (["continue=tuned", "model=one_layer"], "model._target_"),
        (["continue=first", "experiment=figure4"], "continue"),
        (["continue=first", "hydra.run.dir=first"], "choose another hydra.run.dir"),
    ):
        before = contents("first")
        outcome = memcomp_train(*arguments, *(["hydra.run.dir=new"] if "hydra" not in arguments[-1] else []))
        assert outcome.status != 0, arguments
        assert message in outcome.err, arguments
        assert outcome.err.count("\n") == 1
        assert not Path("new").exists()
        assert contents("first") == before


@pytest.mark.usefixtures("first")
def test_a_run_without_kept_chains_is_gone_on_from(memcomp_train: Run) -> None:
    Path("first/weights/pretrain_chains.pt").unlink()
    assert "begin anew, because none were kept" in done(memcomp_train("continue=first", "hydra.run.dir=second"))
