"""What the integration tests share: quick settings, the outcome of a run, real processes."""

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

FAST = ["pretrain.iterations=2", "finetune.iterations=2", "solver.max_steps=20", "solver.n_restarts=5"]


@dataclass(frozen=True)
class Outcome:
    status: int
    out: str
    err: str


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
