"""Ways to run the command line: in this process where that is enough, as a real process where it is not."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from hydra.core.global_hydra import GlobalHydra

from memcomp_lightning.cli import sweep, train

FAST = ["pretrain.iterations=2", "finetune.iterations=2", "solver.max_steps=20", "solver.n_restarts=5"]


@dataclass(frozen=True)
class Outcome:
    status: int
    out: str
    err: str


@pytest.fixture
def memcomp_train(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., Outcome]:
    """Run ``memcomp-train`` in this process, in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["memcomp-train", *arguments])
        monkeypatch.setattr(sweep.RememberSweepFolder, "folder", None)
        GlobalHydra.instance().clear()
        status = 0
        try:
            train.main()
        except SystemExit as stop:
            status = stop.code if isinstance(stop.code, int) else 1
        captured = capfd.readouterr()
        return Outcome(status, captured.out, captured.err)

    return run


def launch(*arguments: str, folder: Path) -> "subprocess.Popen[str]":
    """Start ``memcomp-train`` as a process of its own; one thread, on which the last bits depend."""
    return subprocess.Popen(
        [sys.executable, "-m", "memcomp_lightning.cli.train", *arguments],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def start_process(tmp_path: Path) -> Callable[..., "subprocess.Popen[str]"]:
    """Start ``memcomp-train`` in the test's folder."""

    def start(*arguments: str) -> "subprocess.Popen[str]":
        return launch(*arguments, folder=tmp_path)

    return start
