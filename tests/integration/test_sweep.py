"""A multirun: one table, failures listed, finished jobs not repeated."""

import csv
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn
from omegaconf import DictConfig
from running import FAST, Outcome

from memcomp_lightning.cli import sweep
from memcomp_lightning.runs import pipeline
from memcomp_lightning.runs.lock import held

Run = Callable[..., Outcome]
SWEEP = ["-m", "sampler=cd,pcd", "seed=0,1,2", *FAST, "hydra.sweep.dir=sweep"]


def rows(path: str) -> list[dict[str, str]]:
    with Path(path).open() as file:
        return list(csv.DictReader(file))


def test_table_has_mean_and_error_over_seeds_and_replicas(memcomp_train: Run) -> None:
    outcome = memcomp_train(*SWEEP, "data.partitions=2")
    assert outcome.status == 0, outcome.err
    table = rows("sweep/table.csv")
    assert [row["sampler"] for row in table] == ["cd", "pcd"]
    assert all((row["n_runs"], row["n_values"]) == ("3", "6") for row in table)
    results = [json.loads(path.read_text()) for path in Path("sweep").glob("*sampler=cd*/result.json")]
    accuracies = [accuracy for result in results for accuracy in result["test_accuracy"]]
    assert float(table[0]["test_accuracy_mean"]) == pytest.approx(sum(accuracies) / 6)
    assert outcome.out.count("3 x 2") == 2
    assert "finetune.iterations" not in outcome.out.splitlines()[-6]


def test_failing_job_leaves_the_others_and_is_repeated_alone(
    memcomp_train: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[str] = []
    original = pipeline.run

    def sometimes(*arguments: Any, overrides: dict[str, str], **settings: Any) -> dict[str, Any]:
        trained.append(overrides["seed"])
        if broken and overrides["seed"] == "1" and overrides["sampler"] == "cd":
            raise RuntimeError("the disk caught fire")
        return original(*arguments, overrides=overrides, **settings)

    monkeypatch.setattr(pipeline, "run", sometimes)
    broken = True
    outcome = memcomp_train(*SWEEP)
    assert outcome.status == 1
    assert "1 failed" in outcome.out
    assert "RuntimeError: the disk caught fire" in outcome.out
    assert [row["n_runs"] for row in rows("sweep/table.csv")] == ["2", "3"]
    broken = False
    trained.clear()
    assert memcomp_train(*SWEEP).status == 0
    assert trained == ["1"]
    assert [row["n_runs"] for row in rows("sweep/table.csv")] == ["3", "3"]


def test_all_jobs_are_checked_before_the_first_trains(memcomp_train: Run) -> None:
    outcome = memcomp_train("-m", "sampler=cd,pcd", "pretrain.iterations=2,-1", "hydra.sweep.dir=sweep")
    assert outcome.status == 2
    assert "pretrain.iterations = -1 is not allowed" in outcome.err
    assert "job sampler=cd pretrain.iterations=-1" in outcome.err
    assert not Path("sweep").exists()


def test_batch_size_and_model_can_be_swept(memcomp_train: Run) -> None:
    outcome = memcomp_train(
        "-m", "pretrain.batch_size=null,100", "model=dbn,baseline_bn_relu", "sampler=cd", *FAST
    )
    assert outcome.status == 0, outcome.err
    table = rows(next(str(path) for path in Path("multirun").rglob("table.csv")))
    assert sorted((row["pretrain.batch_size"], row["model"]) for row in table) == [
        ("100", "baseline_bn_relu"),
        ("100", "dbn"),
        ("null", "baseline_bn_relu"),
        ("null", "dbn"),
    ]


def test_paths_among_the_overrides_and_unfinished_jobs(memcomp_train: Run) -> None:
    assert memcomp_train("sampler=cd", *FAST, "hydra.run.dir=first").status == 0
    sweep = ["-m", "sampler=cd,pcd", *FAST, "model.weights=first/weights/pretrain.pt", "hydra.sweep.dir=sweep"]
    assert memcomp_train(*sweep).status == 0
    assert len(rows("sweep/table.csv")) == 2
    (Path("sweep") / "killed job").mkdir()
    outcome = memcomp_train(*sweep)
    assert outcome.status == 1
    assert "killed job\n    did not finish" in outcome.out


def test_nothing_of_a_job_is_kept_that_is_done(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """A launcher keeps what each job returned until the last: with its settings a thousand took 300 MiB."""
    forget, kept = sweep.RememberSweepFolder.on_job_end, list[JobReturn]()

    def forgotten(self: sweep.RememberSweepFolder, config: DictConfig, job_return: JobReturn) -> None:
        assert job_return.cfg is not None
        forget(self, config, job_return)
        kept.append(job_return)

    monkeypatch.setattr(sweep.RememberSweepFolder, "on_job_end", forgotten)
    outcome = memcomp_train("-m", "seed=0,1", *FAST, "sampler=cd", "hydra.sweep.dir=sweep")
    assert outcome.status == 0, outcome.err
    assert [(job.cfg, job.hydra_cfg) for job in kept] == [(None, None), (None, None)]


def test_joblib_launcher_gives_the_same_results(memcomp_train: Run, joblib_launcher: list[str]) -> None:
    sweep = ["-m", "sampler=cd", "seed=0,1", *FAST]
    assert memcomp_train(*sweep, "hydra.sweep.dir=sweep").status == 0
    outcome = memcomp_train(*sweep, *joblib_launcher, "hydra.sweep.dir=parallel")
    assert outcome.status == 0, outcome.err
    for row, other in zip(rows("sweep/table.csv"), rows("parallel/table.csv"), strict=True):
        assert row["test_accuracy_mean"] == other["test_accuracy_mean"]
        assert row["energy_gap_mean"] == other["energy_gap_mean"]


def launching(monkeypatch: pytest.MonkeyPatch, own: Callable[..., Any]) -> Callable[..., Any]:
    """Put a launcher in the place of Hydra's own, which is returned; Hydra imports its plugins itself."""
    name = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
    kind: Any = Plugins.instance().class_name_to_class[name]
    original: Callable[..., Any] = kind.launch
    monkeypatch.setattr(kind, "launch", own)
    return original


def test_a_job_that_its_launcher_lost_is_named(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def one_less(self: Any, jobs: Any, initial_job_idx: int) -> Any:
        return launch(self, jobs[:-1], initial_job_idx)

    sweep = ["-m", "sampler=cd", "seed=0,1,2", *FAST, "hydra.sweep.dir=sweep"]
    for own in ([], ["hydra.sweep.subdir=job${hydra.job.num}"]):
        with monkeypatch.context() as patched:
            launch = launching(patched, one_less)
            outcome = memcomp_train(*sweep, *own)
        assert outcome.status == 1
        assert [row["n_runs"] for row in rows("sweep/table.csv")] == [str(2 * len(own) + 2)]
        lost = outcome.out.partition("1 failed")[2].splitlines()[1:3]
        assert "seed=2" in lost[0]
        assert "seed=1" not in lost[0]
        assert lost[1] == "    left nothing in sweep: its launcher lost it"
    assert memcomp_train(*sweep).status == 0


def test_jobs_that_begin_in_other_folders_write_where_the_sweep_was_typed(
    memcomp_train: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "elsewhere").mkdir()
    here = Path.cwd()

    def elsewhere(self: Any, jobs: Any, initial_job_idx: int) -> Any:
        os.chdir(tmp_path / "elsewhere")
        begun_at.append(initial_job_idx)
        try:
            return launch(self, jobs, initial_job_idx)
        finally:
            os.chdir(here)

    launch, begun_at = launching(monkeypatch, elsewhere), list[int]()
    job = ["-m", "sampler=cd", "seed=0,1", *FAST]
    for own, folder in (
        (["hydra.sweep.dir=sweep"], "sweep"),
        ([], "multirun/*/*"),
    ):
        outcome = memcomp_train(*job, *own)
        assert outcome.status == 0, outcome.err + outcome.out
        assert len(list(here.glob(f"{folder}/*/result.json"))) == 2
        assert not list((tmp_path / "elsewhere").iterdir())
    assert len(begun_at) == 2
    refused = memcomp_train(*job, "hydra.sweep.dir=${hydra.job.name}")
    assert refused.status == 2
    assert "expected a path from the root" in refused.err


def test_a_folder_in_use_is_left_to_the_other_process(memcomp_train: Run) -> None:
    Path("run").mkdir()
    with held(Path("run")):
        outcome = memcomp_train("sampler=cd", *FAST, "hydra.run.dir=run")
    assert outcome.status == 2
    assert f"run is in use by process {os.getpid()} on" in outcome.err
    assert not list(Path("run").glob("*.json"))
    sweep = ["-m", "sampler=cd", "seed=0,1", *FAST, "hydra.sweep.dir=sweep"]
    assert memcomp_train(*sweep).status == 0
    job = next(Path("sweep").glob("*seed=1*"))
    (job / "result.json").unlink()
    with held(job):
        outcome = memcomp_train(*sweep)
    assert outcome.status == 1
    assert "did not finish" in outcome.out
    assert not (job / "error.json").exists()
    assert memcomp_train(*sweep).status == 0
    assert not list(Path("sweep").rglob(".lock*"))
