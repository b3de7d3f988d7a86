"""A killed process goes on to the same bits."""

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from running import QUIET, Outcome, launch

from memcomp_lightning.runs.folder import RunFolder

Run = Callable[..., Outcome]
RUN = [
    "sampler=mode_assisted_pcd",
    "sampler.schedule.p_max=0.5",
    "pretrain=centred",
    "sampler.inner.n_chains=11",
    "pretrain.iterations=4",
    "pretrain.batch_size=300",
    "finetune.iterations=4",
    *("finetune.dropout=0.3", "finetune.patience=3", "data.validation_fraction=0.2"),
    "checkpoint_every=1",
    *[f"+callbacks.{stage}.kill={{_target_:killing.Kill,stage:{stage}}}" for stage in ("pretrain", "finetune")],
    "hydra.run.dir=run",
]

pytestmark = pytest.mark.xdist_group("resume")  # one worker, one uninterrupted run


def killed(folder: Path, stage: str, epoch: int, name: str) -> "subprocess.CompletedProcess[str]":
    """A run that gets a signal at the start of an epoch; the checkpoint of the epoch before is there."""
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("MEMCOMP_KILL", f"{stage}/{epoch}/{name}")
        environment.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        process = launch(*RUN, folder=folder)
        out, err = process.communicate()
    return subprocess.CompletedProcess(RUN, process.returncode, out, err)


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return {
        f"{stage} {name}": tensor
        for stage in ("pretrain", "finetune")
        for name, tensor in torch.load(folder / f"run/weights/{stage}.pt", weights_only=True).items()
    }


UNINTERRUPTED: dict[str, torch.Tensor] = {}


@pytest.mark.filterwarnings("ignore:Checkpoint directory", "ignore:Be aware that when using `ckpt_path`")
@pytest.mark.parametrize(
    ("stage", "epoch"), [("pretrain", 2), ("pretrain", 6), ("finetune", 2)], ids=["layer1", "layer2", "finetune"]
)
def test_killed_run_goes_on_bit_for_bit(memcomp_train: Run, tmp_path: Path, stage: str, epoch: int) -> None:
    if not UNINTERRUPTED:
        (tmp_path / "whole").mkdir()
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(tmp_path / "whole")
            outcome = memcomp_train(*RUN)
        assert outcome.status == 0, outcome.err
        UNINTERRUPTED.update(weights(tmp_path / "whole"))
    process = killed(tmp_path, stage, epoch, "SIGKILL")
    assert process.returncode == -signal.SIGKILL, process.stderr
    assert torch.load(tmp_path / f"run/checkpoints/{stage}/last.ckpt", weights_only=True)["epoch"] == epoch - 1
    assert not (tmp_path / "run/result.json").exists()
    outcome = memcomp_train("resume=run", "trusted=[killing]")
    assert outcome.status == 0, outcome.err
    assert "test accuracy" in outcome.out
    found = weights(tmp_path)
    assert found.keys() == UNINTERRUPTED.keys()
    assert all(UNINTERRUPTED[key].equal(found[key]) for key in found)


@pytest.mark.parametrize("stage", ["pretrain", "finetune"])
@pytest.mark.parametrize("before", ["finish_stage", "forget_checkpoint"])
def test_a_kill_after_the_last_pass_of_a_stage(memcomp_train: Run, stage: str, before: str) -> None:
    """The checkpoint of the last pass has nothing left to train, but what the stage tells of itself."""
    small = ["data=shifting_bars", "data.source.copies=3", "sampler=pcd", "sampler.n_chains=7", *QUIET]
    small += ["model.hidden_sizes=[5,4]", "pretrain.iterations=3", "finetune.iterations=2", "checkpoint_every=1"]
    assert memcomp_train(*small, "hydra.run.dir=whole").status == 0
    original = getattr(RunFolder, before)

    def killed(folder: RunFolder, name: str, *rest: object) -> None:
        if name == stage:
            raise KeyboardInterrupt
        original(folder, name, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RunFolder, before, killed)
        assert memcomp_train(*small, "hydra.run.dir=run").status == 130
    checkpoint = RunFolder(Path("run")).checkpoint(stage)
    assert checkpoint.exists()
    assert memcomp_train("resume=run").status == 0
    assert not checkpoint.exists()
    for name in ("pretrain", "finetune", "pretrain_chains"):
        found, expected = (torch.load(f"{run}/weights/{name}.pt", weights_only=True) for run in ("run", "whole"))
        assert str(found) == str(expected)
    found, expected = (json.loads(Path(run, "result.json").read_text()) for run in ("run", "whole"))
    for result in (found, expected):
        for record in result["stages"].values():
            assert record.pop("wall_time_s") > 0
    assert found["stages"] == expected["stages"]


def test_interrupt_says_how_to_go_on(tmp_path: Path) -> None:
    process = killed(tmp_path, "finetune", 1, "SIGINT")
    assert process.returncode == 130
    assert "Go on with: memcomp-train resume=run 'trusted=[killing]'" in process.stderr
    assert "Traceback" not in process.stderr
    assert not list(tmp_path.rglob("*.partial"))
