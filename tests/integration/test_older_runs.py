"""What versions since 0.3.0 have made is read by this one: runs kept by ``tests/fixtures/runs/make_runs.py``."""

import csv
import json
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from running import Outcome

import memcomp_lightning
from memcomp_lightning.cli import impute, sample, score
from memcomp_lightning.data import Digits, ImageDataModule
from memcomp_lightning.errors import UserError
from memcomp_lightning.trained.alone import LoadWarning

pytest.importorskip("pyarrow")

KEPT = Path(__file__).parents[1] / "fixtures/runs"
VERSIONS = sorted(path.name for path in KEPT.iterdir() if (path / "expected.json").exists())

Run = Callable[..., Outcome]


@pytest.fixture(params=VERSIONS)
def expected(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A copy of the runs of one version in the folder of the test, and what they must give."""
    shutil.copytree(KEPT / request.param, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    content: dict[str, Any] = json.loads(Path("expected.json").read_text())
    return content


def table(path: str) -> list[dict[str, str]]:
    with Path(path).open() as lines:
        return list(csv.DictReader(lines))


def found(folder: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(Path(folder, "result.json").read_text())
    return content


def test_the_first_version_that_keeps_them_is_there() -> None:
    assert "0.3.0" in VERSIONS


def test_networks_have_their_accuracy(expected: dict[str, Any]) -> None:
    run = memcomp_lightning.load("digits")
    assert run.classifier is not None
    images, labels = ImageDataModule(Digits().load()).test
    with torch.no_grad():
        right = run.classifier(images.float()).argmax(-1) == labels
    assert right.float().mean().item() == pytest.approx(expected["test_accuracy"], abs=0.01)
    with torch.no_grad():
        pretrained = memcomp_lightning.load("digits/weights/pretrain.pt").network(images[:5].float())
    assert pretrained.shape[-1] == 8


def test_tables_are_scored_sampled_and_filled(run_command: Any, expected: dict[str, Any]) -> None:
    outcome = run_command("memcomp-score", score.main, ("table", "people.csv", "output=scores.csv"))
    assert outcome.status == 0, outcome.err
    rows = table("scores.csv")[: len(expected["log_likelihood"])]
    for name in ("log_likelihood", "p(cat)"):
        np.testing.assert_allclose([float(row[name]) for row in rows], expected[name], atol=1e-3)
    outcome = run_command("memcomp-sample", sample.main, ("table", "n=20", "output=rows.csv"))
    assert outcome.status == 0, outcome.err
    drawn = table("rows.csv")
    assert len(drawn) == 20
    assert {row["colour"] for row in drawn} <= {"red", "green", "blue"}
    assert all(math.isfinite(float(row["age"])) for row in drawn)
    outcome = run_command("memcomp-impute", impute.main, ("table", "people.csv", "output=filled.csv"))
    assert outcome.status == 0, outcome.err
    assert all(row["colour"] for row in table("filled.csv"))


def test_a_run_that_was_cut_off_ends_as_if_it_was_not(memcomp_train: Run, expected: dict[str, Any]) -> None:
    assert not Path("cut/result.json").exists()
    outcome = memcomp_train("resume=cut")
    assert outcome.status == 0, outcome.err
    assert found("cut")["test_loss"][0] == pytest.approx(expected["test_loss"], abs=1e-3)
    assert found("cut")["test_accuracy"][0] == pytest.approx(expected["test_accuracy"], abs=0.01)


def test_a_finished_run_goes_on_with_other_settings(memcomp_train: Run, expected: dict[str, Any]) -> None:
    outcome = memcomp_train("continue=table", "pretrain.iterations=2", "finetune.iterations=1", "hydra.run.dir=on")
    assert outcome.status == 0, outcome.err
    kept, now = (memcomp_lightning.load(name).network.state_dict() for name in ("table", "on"))
    # Two passes change little, and nothing that begins anew is so near.
    for name, weights in kept.items():
        assert (now[name] - weights).abs().max() < 0.2
        assert kept.keys() == now.keys()
    assert any(not now[name].equal(weights) for name, weights in kept.items())


def test_records_become_a_report(memcomp_report: Run, expected: dict[str, Any]) -> None:
    outcome = memcomp_report("figure")
    assert outcome.status == 0, outcome.err
    assert Path("figure/report.html").stat().st_size > 1000


def test_a_table_of_solutions_goes_on(memcomp_solve: Run, expected: dict[str, Any]) -> None:
    before = table("results.csv")
    Path("problems/pair.txt").write_text("2 1\n1 2 1\n")
    outcome = memcomp_solve(
        *("problems", "solver=annealing,tabu", "solver.n_restarts=4", "--output", "results.csv")
    )
    assert outcome.status == 0, outcome.err
    after = table("results.csv")
    assert len(after) == len(before) + 2
    assert [row for row in after if row in before] == before  # times and all: nothing was solved again


def test_of_older_versions_the_weights_are_read(memcomp_train: Run, tmp_path: Path) -> None:
    """Folders are not; messages say which version made them, and what can be done."""
    shutil.copytree(KEPT / "0.2.0/digits", tmp_path / "old")
    with pytest.raises(UserError, match=r"this one is of version 0\.2\.0.*old/weights/finetune\.pt") as caught:
        memcomp_lightning.load("old")
    assert "old/weights/pretrain.pt" in str(caught.value)
    with pytest.warns(LoadWarning):
        run = memcomp_lightning.load("old/weights/finetune.pt")
    images, labels = ImageDataModule(Digits().load()).test
    assert run.classifier is not None
    with torch.no_grad():
        right = run.classifier(images.float()).argmax(-1) == labels
    assert right.float().mean().item() == pytest.approx(found("old")["test_accuracy"][0], abs=0.01)
    for name in ("resume", "continue"):
        outcome = memcomp_train(f"{name}=old")
        assert outcome.status != 0
        assert re.search("(of|by) version 0.2.0", outcome.err)
    outcome = memcomp_train(
        *("data=digits", "model.hidden_sizes=[16,12]", "model.weights=old/weights/pretrain.pt"),
        *("pretrain.iterations=0", "finetune.iterations=1", "callbacks=minimal", "logger=none"),
    )
    assert outcome.status == 0, outcome.err
