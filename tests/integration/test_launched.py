"""Processes that torchrun or srun starts make one run together, or are told at once what is missing."""

import json
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from running import QUIET, Outcome, Program, python

from memcomp_lightning.runs.lost import Others

Run = Callable[..., Outcome]
TORCHRUN = {
    "TORCHELASTIC_RUN_ID": "none",
    "WORLD_SIZE": "4",
    "LOCAL_WORLD_SIZE": "2",
    "RANK": "1",
    "LOCAL_RANK": "1",
}
SRUN = {
    "SLURM_PROCID": "1",
    "SLURM_NTASKS": "4",
    "SLURM_NNODES": "2",
    "SLURM_JOB_NAME": "train",
    "LOCAL_RANK": "1",
}
HERE = "hydra.run.dir=run"
RIGHT = ["trainer.devices=2", "trainer.num_nodes=2", "trainer.strategy=ddp"]


@pytest.mark.parametrize("environment", [TORCHRUN, SRUN], ids=["torchrun", "srun"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (RIGHT, "started 4 processes, which need one run folder that all of them see: add hydra.run.dir=FOLDER"),
        ([HERE], "Add trainer.devices=2 trainer.num_nodes=2 trainer.strategy=ddp"),
        ([HERE, "trainer.devices=4"], "trainer.devices=4 trainer.num_nodes=1 is not allowed"),
        (["-m", "seed=0,1", "hydra.sweep.dir=sweep"], "each of its 4 processes would start the whole sweep"),
        ([HERE, "experiment=figure4"], "each of its 4 processes would train all of it"),
        ([HERE, *RIGHT, "choose={setting: sampler.k, values: [1, 5]}", "sampler=cd"], "choose with"),
        (["resume=nowhere"], "resume=nowhere: there is no overrides.json"),
    ],
)
def test_refused_before_anything_is_written(
    memcomp_train: Run,
    monkeypatch: pytest.MonkeyPatch,
    environment: dict[str, str],
    arguments: list[str],
    message: str,
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    outcome = memcomp_train(*arguments)
    assert outcome.status == 2
    assert message in outcome.err
    assert list(Path().iterdir()) == []


def test_a_job_of_one_task_is_no_other_than_any_run(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SLURM_PROCID", "0")
    monkeypatch.setenv("SLURM_NTASKS", "1")
    outcome = memcomp_train("sampler=cd", "pretrain.iterations=-1")
    assert (outcome.status, "pretrain.iterations = -1" in outcome.err) == (2, True), outcome.err


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def two_nodes(folder: Path, *arguments: str) -> list[Program]:
    """Two processes as torchrun starts them, one on each of two nodes."""
    own = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "GLOO_SOCKET_IFNAME": "lo"}
    own |= {"TORCHELASTIC_RUN_ID": "none", "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "1", "LOCAL_RANK": "0"}
    program = ["-m", "memcomp_lightning.cli.train", *arguments]
    return [python(*program, folder=folder, **own, RANK=str(r), GROUP_RANK=str(r)) for r in range(2)]


@pytest.mark.skipif(not Path("/sys/class/net/lo").exists(), reason="the name of the loopback device is Linux's")
def test_a_node_that_dies_is_named_and_resume_goes_on_with_all_processes(tmp_path: Path) -> None:
    run = ["sampler=pcd", *QUIET, "preset=paper", "pretrain.iterations=100", "finetune.iterations=0"]
    several = ["trainer.num_nodes=2", "trainer.strategy=ddp", "checkpoint_every=2", "hydra.run.dir=run"]
    first, second = two_nodes(tmp_path, *run, *several)
    until = time.monotonic() + 300
    while not (tmp_path / "run/checkpoints/pretrain/last.ckpt").exists() and time.monotonic() < until:
        time.sleep(0.01)
    second.send_signal(signal.SIGKILL)
    second.communicate()
    _, err = first.communicate()
    assert first.returncode == 2, err
    assert not (tmp_path / "run/result.json").exists()
    assert "the process at 127.0.0.1 has ended or can no longer be reached" in err
    assert "Start the same command again in every process, with hydra.run.dir=" in err
    states = torch.load(tmp_path / "run/checkpoints/pretrain/last.ckpt", weights_only=True)["process_states"]
    assert len(states) == 2
    for process in two_nodes(tmp_path, "resume=run"):
        _, err = process.communicate()
        assert process.returncode == 0, err
    assert json.loads((tmp_path / "run/result.json").read_text())["stages"]["pretrain"]["passes"] == [100, 100]


class Store:
    """What processes wrote where they met."""

    def __init__(self, entries: dict[str, str]) -> None:
        self.entries = {f"memcomp_lightning/{key}": value.encode() for key, value in entries.items()}

    def set(self, key: str, value: str) -> None:
        self.entries[key] = value.encode()

    def check(self, keys: list[str]) -> bool:
        return all(key in self.entries for key in keys)

    def get(self, key: str) -> bytes:
        return self.entries[key]


@pytest.mark.parametrize(
    ("error", "said"),
    [
        ("[gloo/pair.cc:537] Read error [10.0.0.7]:20681: Connection reset", "the process at 10.0.0.7 has ended"),
        (
            "[gloo/unbound_buffer.cc:78] Timed out waiting 15000ms",
            "process 2 on sun and process 3 on an unknown machine",
        ),
    ],
)
def test_who_is_lost(monkeypatch: pytest.MonkeyPatch, error: str, said: str) -> None:
    monkeypatch.setattr("memcomp_lightning.runs.lost._WAIT_S", 0)
    others = Others()
    others._n, others._rank = 4, 0
    others._store = Store({"host/1": "moon", "gave up/1": "yes", "host/2": "sun"})
    assert said in str(others.lost(RuntimeError(error)))
    assert others.lost(RuntimeError("index out of range")) is None
