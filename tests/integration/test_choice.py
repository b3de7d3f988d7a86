"""``choose=``: held-out training images choose a setting before the run, once."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from running import FAST, QUIET, Outcome

Run = Callable[..., Outcome]
RATES = "choose={setting:finetune.optimizer.lr,values:[1e-9,0.5]}"


def found(folder: str) -> Any:
    return json.loads(Path(folder, "result.json").read_text())


def test_the_run_is_the_one_with_the_chosen_value(memcomp_train: Run) -> None:
    small = [*FAST, "sampler=cd", "finetune.iterations=20"]
    outcome = memcomp_train(*small, RATES, "hydra.run.dir=chosen")
    assert outcome.status == 0, outcome.err
    assert "Chosen on held-out training images: finetune.optimizer.lr = 0.5" in outcome.out
    assert memcomp_train(*small, "finetune.optimizer.lr=0.5", "hydra.run.dir=given").status == 0
    chosen = found("chosen")
    assert chosen["test_loss"] == found("given")["test_loss"]
    assert chosen["choice"]["values"] == [1e-9, 0.5]
    assert chosen["choice"]["accuracies"][1] > chosen["choice"]["accuracies"][0]


def test_rows_with_weights_choose_as_all_others_do(memcomp_train: Run) -> None:
    rows = "".join(f"{k % 5 + 0.5},{'ab'[k % 2]},{1 + k % 3}\n" for k in range(60))
    Path("rows.csv").write_text(f"x,kind,w\n{rows}")
    table = ["data=table", "data.path=rows.csv", "data.columns={label: kind, weight: w}", *QUIET]
    outcome = memcomp_train(*table, RATES, "pretrain.iterations=1", "finetune.iterations=3", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert found("run")["choice"]["values"] == [1e-9, 0.5]


def test_lengths_of_training_can_be_chosen(memcomp_train: Run) -> None:
    choose = "choose={setting:finetune.iterations,values:[1,30]}"
    outcome = memcomp_train(*FAST, "sampler=cd", "control=xavier_4", choose, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert found("run")["choice"]["value"] == 30
    assert found("run")["stages"]["finetune"]["iterations"] == 30


def test_the_choice_of_an_interrupted_run_stands(memcomp_train: Run) -> None:
    small = [*FAST, "sampler=cd", RATES, "hydra.run.dir=run"]
    assert memcomp_train(*small).status == 0
    path = Path("run/choice.jsonl")
    records = [json.loads(line) for line in path.read_text().splitlines()]
    path.write_text("".join(json.dumps({**r, "held_out": float(r["value"] == 1e-9)}) + "\n" for r in records))
    Path("run/result.json").unlink()
    Path("run/stages.json").unlink()
    assert memcomp_train("resume=run").status == 0
    assert found("run")["choice"]["value"] == 1e-9


def test_every_job_of_a_sweep_chooses_for_itself(memcomp_train: Run) -> None:
    outcome = memcomp_train("-m", *FAST, "control=cd_best_rate", "seed=0,1", "hydra.sweep.dir=sweep")
    assert outcome.status == 0, outcome.err
    assert len(list(Path("sweep").glob("*/choice.jsonl"))) == 2
    assert Path("sweep/table.csv").exists()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("choose={setting:sampler.speed,values:[1]}", "choose.setting = 'sampler.speed' is no setting"),
        ("choose={setting:sampler.k,values:[]}", "choose.values = []"),
        ("choose={setting:sampler.k,value:[1]}", "setting of choose = 'value'"),
        ("choose={setting:sampler.k,values:[0]}", "k = 0"),
        ("choose={setting:sampler.k,values:[1,0]}", "k = 0"),
        ("choose={setting:sampler.hidden,values:[mean]}", "choose.values = ['mean']"),
        ("choose=rate", "choose"),
    ],
)
def test_what_cannot_be_chosen_is_refused(memcomp_train: Run, override: str, message: str) -> None:
    outcome = memcomp_train(*FAST, "sampler=cd", override, "hydra.run.dir=run")
    assert outcome.status != 0
    assert message in outcome.err
    assert not Path("run").exists()


def test_nothing_is_chosen_by_test_images(memcomp_train: Run) -> None:
    outcome = memcomp_train(*FAST, "control=bn_relu_regularised", "data.validation_fraction=0")
    assert outcome.status != 0
    assert "The test images would choose the pass." in outcome.err
    outcome = memcomp_train(*FAST, "sampler=cd", RATES, "finetune.iterations=0")
    assert outcome.status != 0
    assert "finetune.iterations = 0 is not allowed" in outcome.err
