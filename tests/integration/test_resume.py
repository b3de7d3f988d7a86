"""A killed process goes on to the same bits."""

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from running import launch

Start = Callable[..., "subprocess.Popen[str]"]
RUN = [
    "sampler=mode_assisted_pcd",
    "sampler.schedule.p_max=0.5",
    "pretrain=centred",
    "sampler.inner.n_chains=11",
    "pretrain.iterations=20",
    "pretrain.batch_size=300",
    "finetune.iterations=40",
    "checkpoint_every=1",
]


def wait_for_epoch(process: "subprocess.Popen[str]", checkpoint: Path, epoch: int) -> None:
    """Until the process has written a checkpoint of this epoch or a later one."""
    deadline = time.monotonic() + 100
    while time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        try:
            if torch.load(checkpoint, weights_only=True)["epoch"] >= epoch:
                return
        except FileNotFoundError:
            time.sleep(0.01)
    raise AssertionError(f"{checkpoint} never came to epoch {epoch}")


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("uninterrupted")
    process = launch(*RUN, "hydra.run.dir=run", folder=folder)
    _, err = process.communicate()
    assert process.returncode == 0, err
    return folder / "run"


@pytest.mark.xdist_group("resume")  # one worker, one uninterrupted run
@pytest.mark.parametrize(
    ("stage", "epoch"), [("pretrain", 3), ("pretrain", 22), ("finetune", 4)], ids=["layer1", "layer2", "finetune"]
)
def test_killed_run_goes_on_bit_for_bit(
    uninterrupted: Path, start_process: Start, tmp_path: Path, stage: str, epoch: int
) -> None:
    killed = start_process(*RUN, "hydra.run.dir=run")
    wait_for_epoch(killed, tmp_path / "run/checkpoints" / stage / "last.ckpt", epoch)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert not (tmp_path / "run/result.json").exists()
    resumed = start_process("resume=run")
    out, err = resumed.communicate()
    assert resumed.returncode == 0, err
    assert "test accuracy" in out
    for name in ("pretrain", "finetune"):
        expected = torch.load(uninterrupted / "weights" / f"{name}.pt", weights_only=True)
        found = torch.load(tmp_path / "run/weights" / f"{name}.pt", weights_only=True)
        assert all(expected[key].equal(found[key]) for key in expected)


def test_interrupt_says_how_to_go_on(start_process: Start, tmp_path: Path) -> None:
    process = start_process(*RUN, "hydra.run.dir=run", "finetune.iterations=10000")
    wait_for_epoch(process, tmp_path / "run/checkpoints/finetune/last.ckpt", 1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Go on with: memcomp-train resume=run" in err
    assert "Traceback" not in err
    assert not list(tmp_path.rglob("*.partial"))
