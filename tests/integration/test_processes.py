"""Two real processes do the full-batch update of one."""

import json
import random
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from running import Outcome, Program, python

Run = Callable[..., Outcome]
Start = Callable[..., Program]
RUN = [
    "preset=paper",
    "sampler=ground_state",
    "solver=alternating_descent",
    "pretrain.iterations=4",
    "finetune.iterations=3",
    "finetune.batch_size=null",
    "finetune.optimizer.lr=1.0",
]


def test_two_processes_give_the_update_of_one(memcomp_train: Run, start_process: Start, tmp_path: Path) -> None:
    one = memcomp_train(*RUN, "hydra.run.dir=one")
    assert one.status == 0, one.err
    distributed = ["trainer.devices=2", "trainer.strategy=ddp", "data.chunk_size=300"]
    two = start_process(*RUN, "hydra.run.dir=two", *distributed)
    out, err = two.communicate()
    assert two.returncode == 0, err
    for stage in ("pretrain", "finetune"):
        expected = torch.load(tmp_path / "one/weights" / f"{stage}.pt", weights_only=True)
        found = torch.load(tmp_path / "two/weights" / f"{stage}.pt", weights_only=True)
        for name, tensor in expected.items():
            torch.testing.assert_close(found[name], tensor, rtol=1e-5, atol=1e-6)
    gaps = [
        json.loads((tmp_path / name / "result.json").read_text())["stages"]["pretrain"]["energy_gap"]
        for name in ("one", "two")
    ]
    assert torch.tensor(gaps[0]) == pytest.approx(torch.tensor(gaps[1]), rel=1e-4)
    assert out.count("test accuracy") == 1, "the table is printed once"


def test_two_processes_that_share_a_table_give_the_update_of_one(
    memcomp_train: Run, start_process: Start, tmp_path: Path
) -> None:
    pytest.importorskip("pyarrow")
    draw = random.Random(0)
    (tmp_path / "parts").mkdir()
    for number, n in enumerate((40, 3, 90, 68)):
        lines = [f"{draw.randint(0, 1)},{draw.gauss(number, 2):.4f},{draw.choice('abc')}" for _ in range(n)]
        lines[1] = lines[1].replace(lines[1].split(",")[1], "")
        weights = [f"{line},{1 + number}" for line in lines]
        (tmp_path / f"parts/{number}.csv").write_text("\n".join(["bit,x,word,w", *weights]) + "\n")
    run = [
        "data=table",
        "data.path=parts/*.csv",
        "data.columns={weight: w}",
        "model.hidden_sizes=[3]",
        "sampler=exact",
    ]
    run += ["pretrain.iterations=4", "pretrain.batch_size=null", "pretrain.optimizer.lr=0.5"]
    run += ["model.weight_init.std=0.5", "data.validation_fraction=0.2", "callbacks=minimal", "logger=none"]
    one = memcomp_train(*run, "hydra.run.dir=one")
    assert one.status == 0, one.err
    two = start_process(*run, "hydra.run.dir=two", "trainer.devices=2", "trainer.strategy=ddp")
    out, err = two.communicate()
    assert two.returncode == 0, err
    assert "181 rows to train on, 20 test rows" in out
    assert "shared by 2 processes" in out
    assert "shared by" not in one.out
    assert (tmp_path / "one/schema.json").read_text() == (tmp_path / "two/schema.json").read_text()
    expected, found = (
        torch.load(tmp_path / name / "weights/pretrain.pt", weights_only=True) for name in ("one", "two")
    )
    for name, tensor in expected.items():
        torch.testing.assert_close(found[name], tensor, rtol=1e-4, atol=1e-5)
    results = [json.loads((tmp_path / name / "result.json").read_text()) for name in ("one", "two")]
    likelihoods = [result["stages"]["pretrain"]["log_likelihood"][-1]["heldout"] for result in results]
    assert likelihoods[0] == pytest.approx(likelihoods[1], rel=1e-4)
    gaps = [result["stages"]["pretrain"]["energy_gap"] for result in results]
    assert torch.tensor(gaps[0]) == pytest.approx(torch.tensor(gaps[1]), rel=1e-3, abs=1e-5)


def test_chains_and_streams_differ_between_processes_and_resume(tmp_path: Path) -> None:
    script = tmp_path / "chains.py"
    script.write_text(
        """
import lightning.pytorch as pl, torch
from lightning.pytorch.callbacks import ModelCheckpoint
from memcomp_lightning.data import Digits, ImageDataModule
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.training import Greedy
from memcomp_lightning.samplers import PCD
from memcomp_lightning import rng
from memcomp_lightning.types import Configurations, NegativePhase, NoState

def fit(epochs, resume=None):
    module = EnergyPretraining(Greedy(DBN(32, [5])), PCD(n_chains=7), iterations=4)
    keep = ModelCheckpoint("ckpt", filename=f"to{epochs}", save_on_train_epoch_end=True)
    trainer = pl.Trainer(max_epochs=epochs, devices=2, strategy="ddp", accelerator="cpu", logger=False,
                         callbacks=[keep], enable_progress_bar=False, enable_model_summary=False)
    data = ImageDataModule(Digits().load(), batch_size=100)
    trainer.fit(module, datamodule=data, ckpt_path=resume, weights_only=True)
    return module, trainer

class OwnAnswer:
    # Its answers differ in number between processes: only sharing makes them agree.
    uses_data, shared, calls = False, True, 0
    def init(self, model, n_chains, *, generator):
        return NoState()
    def sample(self, model, state, positive, *, generator):
        OwnAnswer.calls += 1
        n = torch.distributed.get_rank() + 2
        v = rng.bernoulli(torch.full((n, model.n_visible), 0.5), generator=generator)
        return NegativePhase(Configurations(v, model.hidden_mean(v).detach()), state, {})

def fit_shared():
    module = EnergyPretraining(Greedy(DBN(32, [5])), OwnAnswer(), iterations=3)
    trainer = pl.Trainer(max_epochs=3, devices=2, strategy="ddp", accelerator="cpu", logger=False,
                         enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False)
    trainer.fit(module, datamodule=ImageDataModule(Digits().load(), batch_size=None, chunk_size=300))
    calls = [None, None]
    torch.distributed.all_gather_object(calls, OwnAnswer.calls)
    if trainer.is_global_zero:
        print("calls of a shared sampler:", calls)

fit_shared()
fit(2)
whole, _ = fit(4)
resumed, trainer = fit(4, "ckpt/to2.ckpt")
if trainer.is_global_zero:
    same = all(a.equal(b) for a, b in zip(whole.parameters(), resumed.parameters()))
    states = torch.load("ckpt/to2.ckpt", weights_only=True)["process_states"]
    chains = [state["extra"]["sampler"]["x"] for state in states]
    streams = [state["streams"]["negative_phase"] for state in states]
    print("resumed to the same bits:", same, "own chains:", not chains[0].equal(chains[1]),
          "own streams:", not streams[0].equal(streams[1]))
"""
    )
    process = python(str(script), folder=tmp_path)
    out, err = process.communicate()
    assert process.returncode == 0, err
    assert "calls of a shared sampler: [3, 0]" in out, "one answer an update serves both processes"
    assert "resumed to the same bits: True own chains: True own streams: True" in out
