"""Fine-tuning with labels for some: the same rows for every method, an early end, classes that count alike."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose
from running import FAST, QUIET, Outcome

from memcomp_lightning.callbacks import StillFalling
from memcomp_lightning.configuration.composition import composing
from memcomp_lightning.configuration.plans import build
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.runs import pipeline
from memcomp_lightning.studies import AccuracyTrial
from memcomp_lightning.studies.plan import Plan
from memcomp_lightning.training import ClassWeighted

Run = Callable[..., Outcome]
BARS = [*QUIET, "data=shifting_bars", "data.source.copies=4", "sampler=cd", "model.hidden_sizes=[5]"]
SHORT = ["pretrain.iterations=1", "finetune.iterations=2"]
BASELINE = ["control=bn_relu", "pretrain.iterations=0"]


def plan(*overrides: str) -> Plan:
    with composing():
        return build(compose("config", [*BARS, *SHORT, *overrides]))


def rows(of: Plan) -> tuple[torch.Tensor, ...]:
    assert of.finetuning is not None
    return of.finetuning.data.train + of.finetuning.data.heldout


def found(folder: str) -> Any:
    return json.loads(Path(folder, "result.json").read_text())


def test_every_method_learns_from_the_same_rows_at_the_same_seed(
    memcomp_train: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = ["finetune.labels=18", "data.validation_fraction=0.25", "seed=4"]
    first = rows(plan(*settings))
    assert [len(part) for part in first] == [14, 14, 4, 4]
    for other in (["control=no_pretraining"], BASELINE, ["finetune.batch_size=3"]):
        assert all(a.equal(b) for a, b in zip(first, rows(plan(*settings, *other)), strict=True))
    assert not all(a.equal(b) for a, b in zip(first, rows(plan(*settings, "seed=5")), strict=True))
    seen = []
    monkeypatch.setattr(pipeline, "logistic_regression", lambda train, test: seen.append(train) or 0.5)
    outcome = memcomp_train(*BARS, *SHORT, *settings, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert all(a.equal(b) for a, b in zip(first[:2], seen[0], strict=True))
    assert "finetune, 18 labels" in outcome.out
    assert found("run")["labels"] == 18


def test_few_labels_are_watched_for_too_few_passes() -> None:
    for settings, n in ((["finetune.labels=18"], 1), ([], 0)):
        finetuning = plan(*settings).finetuning
        assert finetuning is not None
        assert sum(isinstance(callback, StillFalling) for callback in finetuning.callbacks) == n


def test_a_table_may_lack_some_of_its_labels(memcomp_train: Run) -> None:
    words = ["a", "b", "", "-1"]
    lines = [f"{k % 2},{k % 3},{words[k % 4]}" for k in range(80)]
    Path("rows.csv").write_text("\n".join(["x,y,kind", *lines]) + "\n")
    table = [*QUIET, "data=table", "data.path=rows.csv", "data.columns={label: kind}", *SHORT]
    outcome = memcomp_train(*table, "pretrain.batch_size=null", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    with composing():
        stages = build(compose("config", table)).stages
    n_known = [stage.data.n_train for stage in stages]
    assert n_known == [72, found("run")["labels"]]
    assert 30 < n_known[1] < 42
    assert stages[1].data.train[1].unique().tolist() == [0, 1]
    assert f"finetune, {n_known[1]} labels" in outcome.out


def test_a_sweep_over_the_number_of_labels(memcomp_train: Run) -> None:
    outcome = memcomp_train("-m", *BARS, *SHORT, "finetune.labels=9,18", "hydra.sweep.dir=sweep")
    assert outcome.status == 0, outcome.err
    lines = [line.split(",") for line in Path("sweep/table.csv").read_text().splitlines()]
    assert [line[lines[0].index("finetune.labels")] for line in lines[1:]] == ["9", "18"]


def test_patience_ends_fine_tuning_with_its_best_pass(memcomp_train: Run) -> None:
    still = [*BARS, "pretrain.iterations=0", "data.validation_fraction=0.25", "finetune.iterations=9"]
    # Weights that do not move: no pass is better than the first.
    still += ["finetune.optimizer.lr=1e-12", "finetune.patience=2"]
    outcome = memcomp_train(*still, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert found("run")["stages"]["finetune"]["passes"] == [3]
    assert "3 of 9" in outcome.out


def test_trials_of_several_seeds_are_not_fine_tuned_together_where_their_labels_differ() -> None:
    with composing():
        config: Any = compose("config", [*BARS, *SHORT])
    settings = {"data": {}, "trainer": {}, "finetune": {"labels": None}, "model": config.model}
    for labels, together in ((None, True), (18, False)):
        settings["finetune"] = {"labels": labels}
        settings["model"] = {"_target_": "x", "hidden_sizes": [5]}
        made = [
            AccuracyTrial(method="m", settings=settings, build=build, iterations=1, seed=seed)  # type: ignore[arg-type]
            for seed in (0, 1)
        ]
        assert (made[0].fine_tuning == made[1].fine_tuning) is together


def test_class_weights_reach_the_loss() -> None:
    balanced = plan("finetune.class_weights=balanced", "finetune.labels=20").finetuning
    given = plan(f"finetune.class_weights={[1] * 8 + [2.5]}").finetuning
    label = torch.arange(9)
    for stage in (balanced, given):
        assert isinstance(stage.module.loss, ClassWeighted)  # type: ignore[union-attr]
    assert given.module.loss.of(label).tolist() == [1.0] * 8 + [2.5]  # type: ignore[union-attr]
    totals = balanced.data.class_totals  # type: ignore[union-attr]
    torch.testing.assert_close(balanced.module.loss.of(label) * totals, torch.full((9,), 20 / 9))  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["finetune.patience=2"], r"data.validation_fraction = 0.0 .*finetune.patience is set.*choose the pass"),
        (["finetune.patience=0", "data.validation_fraction=0.2"], "finetune.patience = 0"),
        (["pretrain.patience=2"], r"pretrain.patience = 2 .*pretrain.keep_best=true"),
        (["pretrain.patience=0"], "pretrain.patience = 0"),
        (
            ["pretrain.patience=2", "pretrain.keep_best=true"],
            r"data.validation_fraction = 0.0 .*pretrain.patience",
        ),
        (["finetune.best_by=auc", "finetune.keep_best=true"], "finetune.best_by = 'auc'"),
        (["finetune.class_weights=equal"], r"finetune.class_weights = 'equal' .*balanced.*9 numbers > 0"),
        (["finetune.class_weights=[1,2]"], r"finetune.class_weights = \[1, 2\] .*0, 1, 2"),
        (["finetune.class_weights=[1,1,1,1,1,1,1,1,0]"], "finetune.class_weights"),
        (["finetune.dropout=1.0"], r"finetune.dropout = 1.0 .*\[0, 1\)"),
        (["finetune.labels=5"], "finetune.labels = 5 .*9 classes"),
    ],
)
def test_what_is_out_of_range_is_refused(overrides: list[str], message: str) -> None:
    with pytest.raises((SettingError, UserError), match=message):
        plan(*overrides)


@pytest.mark.parametrize("setting", ["trainer.check_val_every_n_epoch=2", "+trainer.val_check_interval=0.5"])
def test_patience_counts_passes(memcomp_train: Run, setting: str) -> None:
    overrides = [*FAST, "sampler=cd", "data.validation_fraction=0.2", "finetune.batch_size=20"]
    outcome = memcomp_train(*overrides, "finetune.patience=1", setting, "hydra.run.dir=run")
    assert outcome.status != 0
    name, value = setting.split("=")
    assert f"{name.lstrip('+')} = {value} is not allowed: expected once a pass" in outcome.err
    assert not Path("run").exists()
