"""Runs that are copied to an address, go on from there, and are used from there."""

import json
import os
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import pytest
import torch
from running import QUIET, Outcome, launch

from memcomp_lightning import load
from memcomp_lightning.cli.commands import sample

Run = Callable[..., Outcome]
SMALL = [
    *(*QUIET, "sampler=cd", "model.hidden_sizes=[8]", "pretrain.batch_size=200", "checkpoint_every=1"),
    *("pretrain.iterations=4", "finetune.iterations=2"),
]


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return dict(torch.load(folder / "weights/finetune.pt", weights_only=True))


def same(a: Path, b: Path) -> bool:
    mine, others = weights(a), weights(b)
    return mine.keys() == others.keys() and all(mine[name].equal(others[name]) for name in mine)


def test_a_machine_that_is_lost_with_its_disk(
    memcomp_train: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed in training, its folder gone, the run goes on from its address to the same bits."""
    store = tmp_path / "store/mine"
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
    monkeypatch.syspath_prepend(Path(__file__).parent)
    monkeypatch.setenv("MEMCOMP_COPY", f"{store}/checkpoints/pretrain/last.ckpt")
    kill = "+callbacks.pretrain.kill={_target_:killing.KillOnceCopied,epoch:2}"
    address = f"copy_to=file://{store}"
    process = launch(*SMALL, kill, address, "copy_every=0.02", "hydra.run.dir=lost", folder=tmp_path)
    _, err = process.communicate()
    assert process.returncode == -9, err
    shutil.rmtree(tmp_path / "lost")

    outcome = memcomp_train(f"resume=file://{store}")
    assert outcome.status == 2
    assert "killing.KillOnceCopied" in outcome.err  # fetched, and not trusted
    outcome = memcomp_train("resume=runs/mine", address, "trusted=[killing]")
    assert outcome.status == 0, outcome.err
    assert json.loads((store / "result.json").read_text())["stages"]["pretrain"]["passes"] == [4]
    assert not (store / "checkpoints/pretrain/last.ckpt").exists()
    assert same(Path("runs/mine"), store)

    assert memcomp_train(*SMALL, "hydra.run.dir=whole").status == 0
    assert same(Path("whole"), store)


def test_a_run_at_an_address_is_used_like_one_in_a_folder(
    memcomp_train: Run, run_command: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    address = f"file://{tmp_path}/store/mine"
    assert memcomp_train(*SMALL, f"copy_to={address}", "hydra.run.dir=mine").status == 0
    assert load(address).model.n_hidden == 8
    outcome = run_command("memcomp-sample", sample.main, (address, "n=3", "output=rows.npz"))
    assert outcome.status == 0, outcome.err
    outcome = memcomp_train(f"continue={address}", "pretrain.iterations=1", "hydra.run.dir=on")
    assert outcome.status == 0, outcome.err
    assert not (tmp_path / "store/on").exists()
    assert not Path("on/.copied.json").exists()


def test_the_same_address_is_not_written_twice(memcomp_train: Run, tmp_path: Path) -> None:
    address = f"file://{tmp_path}/store/mine"
    assert memcomp_train(*SMALL, f"copy_to={address}", "hydra.run.dir=mine").status == 0
    assert memcomp_train(*SMALL, "hydra.run.dir=other").status == 0
    outcome = memcomp_train("resume=other", f"copy_to={address}")
    assert outcome.status == 2
    assert f"Go on with it by resume={address}" in outcome.err
    outcome = memcomp_train(*SMALL, "seed=1", f"copy_to={address}", "hydra.run.dir=third")
    assert outcome.status == 2
    assert "was made with seed=0, not 1" in outcome.err  # what is there is fetched, and is another run


def test_the_same_sweep_goes_on_on_another_machine(memcomp_train: Run, tmp_path: Path) -> None:
    """Each job has an address of its own, by a name that says nothing of addresses."""
    address = f"file://{tmp_path}/store"
    sweep = [*SMALL, "-m", "sampler.k=1,2", f"copy_to={address}", "hydra.sweep.dir=sweep"]
    assert memcomp_train(*sweep).status == 0
    jobs = sorted(path.name for path in Path("sweep").iterdir() if path.is_dir())
    assert len(jobs) == 2
    assert not any("copy_to" in job for job in jobs)
    finished = (tmp_path / "store" / jobs[0] / "result.json").read_text()
    shutil.rmtree("sweep")
    (tmp_path / "store" / jobs[1] / "result.json").unlink()

    outcome = memcomp_train(*sweep)
    assert outcome.status == 0, outcome.err
    assert sorted(path.name for path in Path("sweep").iterdir() if path.is_dir()) == jobs
    assert Path("sweep", jobs[0], "result.json").read_text() == finished
    assert (tmp_path / "store" / jobs[1] / "result.json").is_file()

    outcome = memcomp_train(f"resume={address}/{jobs[0]}")
    assert outcome.status == 0, outcome.err
    assert Path("runs", jobs[0], "result.json").read_text() == finished


def test_a_copy_that_fails_names_the_command_that_copies(
    memcomp_train: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = "memory://bucket/it's a run"
    monkeypatch.setattr(fsspec.get_filesystem_class("memory"), "put_file", broken)
    outcome = memcomp_train(*SMALL, f"copy_to={address}", "hydra.run.dir=mine")
    assert outcome.status == 2
    assert "cannot be written (PermissionError: not yours). The run is whole in mine." in outcome.err
    command = shlex.split(outcome.err.strip().partition("Copy it with: ")[2])
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    outcome = memcomp_train(*command[1:])
    assert outcome.status == 0, outcome.err
    assert fsspec.filesystem("memory").exists("/bucket/it's a run/result.json")


def broken(self: object, here: str, there: str) -> None:
    raise PermissionError("not yours")


def test_a_report_and_a_figure_of_an_address(
    memcomp_train: Run, memcomp_report: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    address = f"file://{tmp_path}/store/figure"
    figure = [
        *("experiment=figure4", "figure/curves=none", "data=digits", "data.partitions=2", "figure.passes=[1]"),
        *("figure.seeds=[0]", "figure.iterations=[1]", "solver.max_steps=5", "solver.n_restarts=2"),
        *("figure.workers=1", "hydra.run.dir=figure", f"copy_to={address}"),
    ]
    assert memcomp_train(*figure).status == 0
    assert (tmp_path / "store/figure/records.jsonl").is_file()
    shutil.rmtree("figure")
    outcome = memcomp_report(address)
    assert outcome.status == 0, outcome.err
    assert Path("report.html").is_file()


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("copy_to=runs/copy", "copy_to = 'runs/copy' is not allowed: expected an address"),
        ("copy_to=nowhere://run", "nowhere://run cannot be reached"),
        ("copy_every=0 copy_to=memory://run", "copy_every = 0 is not allowed: expected seconds in (0, 86400]"),
        ("resume=memory://nothing", "memory://nothing: there is nothing"),
        ("continue=memory://nothing", "memory://nothing: there is nothing"),
    ],
)
def test_what_cannot_be_copied_or_fetched_is_said_before_training(
    memcomp_train: Run, override: str, said: str
) -> None:
    outcome = memcomp_train(*override.split())
    assert outcome.status == 2
    assert said in outcome.err
    assert list(Path().iterdir()) == []


def test_a_stranger_cannot_send_a_run_elsewhere(memcomp_train: Run, tmp_path: Path) -> None:
    """Their folder may say where it is copied to; only who goes on with it decides whether it is."""
    theirs = f"file://{tmp_path}/theirs"
    assert memcomp_train(*SMALL, f"copy_to={theirs}", "hydra.run.dir=mine").status == 0
    shutil.rmtree(tmp_path / "theirs")
    outcome = memcomp_train("resume=mine")
    assert outcome.status == 2
    assert f"this run was copied to {theirs}. Copy it there again with memcomp-train resume=" in outcome.err
    assert memcomp_train("resume=mine", "copy_to=null").status == 0
    assert not (tmp_path / "theirs").exists()
