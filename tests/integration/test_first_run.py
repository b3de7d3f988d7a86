"""What the first commands say of a run: likelihoods without looking for them, and rows to compare with."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from running import Outcome

Run = Callable[..., Outcome]
BARS = ["data=shifting_bars", "model.hidden_sizes=[6]", "sampler=exact", "logger=none", "hydra.run.dir=run"]


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def result() -> dict:
    return json.loads(Path("run/result.json").read_text())


def test_about_ten_likelihoods_a_stage_and_rows_of_context(memcomp_train: Run) -> None:
    outcome = memcomp_train(*BARS, "pretrain.iterations=40", "finetune.iterations=1")
    assert outcome.status == 0, outcome.err
    found = result()
    values = found["stages"]["pretrain"]["log_likelihood"]
    assert 10 <= len(values) <= 12
    assert [value["iteration"] for value in values][-1] == 40
    assert values[-1]["heldout"][0] > values[0]["heldout"][0]  # the exact gradient raises the likelihood
    assert found["context"]["independent_units"]["heldout"] < 0
    assert found["context"]["logistic_regression"]["n_images"] == 9
    title = next(line for line in outcome.out.splitlines() if line.strip().startswith("stage"))
    assert "log-likelihood (held-out)" in title
    assert "test accuracy" in title
    assert f"{values[-1]['heldout'][0]:.2f}" in outcome.out
    assert "(logistic regression)" in outcome.out
    assert "(independent units)" in outcome.out


def test_a_run_without_labels_ends_with_likelihoods_and_no_empty_column(memcomp_train: Run) -> None:
    outcome = memcomp_train(*BARS, "pretrain.iterations=5", "finetune.iterations=0")
    assert outcome.status == 0, outcome.err
    assert "log-likelihood (held-out)" in outcome.out
    assert "accuracy" not in outcome.out
    assert "logistic" not in outcome.out


def test_likelihoods_go_on_after_an_interruption(memcomp_train: Run) -> None:
    assert memcomp_train(*BARS, "pretrain.iterations=20", "finetune.iterations=1").status == 0
    whole = result()["stages"]["pretrain"]["log_likelihood"]
    Path("run/result.json").unlink()
    Path("run/stages.json").unlink()
    assert memcomp_train("resume=run").status == 0
    assert result()["stages"]["pretrain"]["log_likelihood"] == whole


def test_a_sweep_without_labels_is_told_apart_by_likelihood(memcomp_train: Run) -> None:
    arguments = [*BARS[:-1], "hydra.sweep.dir=sweep", "pretrain.iterations=2", "finetune.iterations=0"]
    outcome = memcomp_train("-m", "pretrain.optimizer.lr=0.1,0.2", *arguments)
    assert outcome.status == 0, outcome.err
    assert "log-likelihood (held-out), first layer" in outcome.out
    assert "accuracy" not in outcome.out
    assert "log_likelihood_mean" in Path("sweep/table.csv").read_text()
