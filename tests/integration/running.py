"""What the integration tests share: quick settings, the outcome of a run, real processes."""

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

THREADS = os.environ.get("MEMCOMP_THREADS", "1")
"""Of every process, as in this one: the last bits depend on their number."""

HANGS_AFTER = 900
"""Seconds after which a process is given up; far more than it takes on a busy machine."""

QUIET = ["callbacks=minimal", "logger=none"]
"""Half of the time of a small run is that of its pictures."""

FAST = [
    *(*QUIET, "preset=paper", "pretrain.iterations=2", "finetune.iterations=2"),
    *("solver.max_steps=20", "solver.n_restarts=5"),
]
"""Few updates: those of the paper are of all images."""

LOGGED = [*FAST, "callbacks=default", "logger=tensorboard"]

# D-Wave's own mock of a Pegasus annealer, with a few qubits missing, in place of the service.
MOCK_QPU = (
    "sampler.sampler.qpu={_target_:dwave.system.testing.MockDWaveSampler,topology_type:pegasus,topology_shape:[6],"
    "broken_nodes:[33,108,402],parameter_warnings:false,exact_solver_cutoff:0}"
)


@dataclass(frozen=True)
class Outcome:
    status: int
    out: str
    err: str


def launch(*arguments: str, folder: Path, command: str = "train") -> "subprocess.Popen[str]":
    """Start a command as a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", f"memcomp_lightning.cli.{command}", *arguments],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": THREADS},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Ctrl-C stops the process even where the shell of these tests runs them in the background.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
