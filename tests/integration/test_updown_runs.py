"""Up-down training under a trainer and from the command line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from running import FAST, Outcome

from memcomp_lightning import rng
from memcomp_lightning.data import ImageDataModule, ShiftingBars
from memcomp_lightning.errors import UserError
from memcomp_lightning.models import DBN, GenerativeDBN
from memcomp_lightning.modules import UpDown
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import PCD
from memcomp_lightning.trained import load_generative
from memcomp_lightning.training import EnergyStep, UpDownStep, up_down

Run = Callable[..., Outcome]

STEP = UpDownStep(top=EnergyStep(sampler=PCD(n_chains=7), centring=Centring(rate=0.1)))


def rows() -> ImageDataModule:
    return ImageDataModule(ShiftingBars().load(), batch_size=4, chunk_size=3)


def generative(data: ImageDataModule) -> GenerativeDBN:
    n = data.train[0].shape[-1]
    return GenerativeDBN(DBN(n, [5, 4], generator=rng.stream(0, "weights")), n_classes=data.n_classes)


def fit(module: UpDown, data: ImageDataModule, **settings: Any) -> pl.Trainer:
    trainer = pl.Trainer(
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        max_epochs=settings.pop("max_epochs", module.n_epochs),
    )
    trainer.fit(module, datamodule=data, **settings)
    return trainer


def weights(model: torch.nn.Module) -> list[torch.Tensor]:
    return [tensor.clone() for tensor in model.state_dict().values()]


def test_a_trainer_does_what_the_bare_loop_does() -> None:
    data = rows()
    module, bare = UpDown(generative(data), step=STEP, iterations=3), generative(data)
    before = weights(bare)
    trainer = fit(module, data)
    batches = data.train_batches(0, 1)
    *_, losses = up_down(bare, batches, step=STEP, iterations=3, optimizer=lambda p: torch.optim.SGD(p, lr=0.05))
    for name in ("wake", "sleep"):
        assert float(trainer.callback_metrics[f"updown/{name}"]) > 0
        assert float(getattr(losses, name)) > 0
    for x, y, z in zip(weights(module.network), weights(bare), before, strict=True):
        assert x.equal(y)
        assert not x.equal(z) or not z.numel()


@pytest.mark.filterwarnings("ignore:Be aware that when using `ckpt_path`")
def test_it_goes_on_from_a_checkpoint_to_the_same_bits(tmp_path: Path) -> None:
    data = rows()
    whole, part, rest = (UpDown(generative(data), step=STEP, iterations=4) for _ in range(3))
    fit(whole, data)
    fit(part, data, max_epochs=2).save_checkpoint(tmp_path / "two.ckpt")
    fit(rest, data, ckpt_path=tmp_path / "two.ckpt", weights_only=True)
    assert all(x.equal(y) for x, y in zip(weights(whole.network), weights(rest.network), strict=True))


COMMAND = [*FAST, "data=bars_and_stripes", "sampler=cd", "model.hidden_sizes=[6,5]", "control=shuffled"]


def read(folder: str, stage: str) -> dict[str, torch.Tensor]:
    found: dict[str, torch.Tensor] = torch.load(f"{folder}/weights/{stage}.pt", weights_only=True)
    return found


def test_a_command_trains_a_copy_of_the_pretrained_network(
    memcomp_train: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    still = ["updown=contrastive", "updown.iterations=1", "updown.optimizer.lr=0"]
    outcome = memcomp_train(*COMMAND, *still, "hydra.run.dir=with")
    assert outcome.status == 0, outcome.err
    assert any(line.split()[:2] == ["updown", "1"] for line in outcome.out.splitlines())
    outcome = memcomp_train(*COMMAND, "hydra.run.dir=without")
    assert outcome.status == 0, outcome.err
    pretrained, found = read("with", "pretrain"), read("with", "updown")
    assert found["generative.0.weight"].equal(pretrained["rbms.0.weight"].mT)
    assert found["recognition.0.bias"].equal(pretrained["rbms.0.c"])
    assert found["top.weight"][:, :6].equal(pretrained["rbms.1.weight"])
    model, start = load_generative("with"), load_generative("with", pretrained=True)
    assert model.n_classes == len(found["top.b"]) - 6 > 1
    assert start.n_classes == 0
    assert model.downward[0].weight.equal(start.downward[0].weight)
    with pytest.raises(UserError, match="updown=contrastive"):
        load_generative("without")
    outcome = memcomp_train(
        *COMMAND, *still, "pretrain.iterations=0", "finetune.iterations=0", "hydra.run.dir=alone"
    )
    assert outcome.status == 0, outcome.err
    assert load_generative("alone").top.weight.equal(read("alone", "updown")["top.weight"])
    with pytest.raises(UserError, match="was not pretrained"):
        load_generative("alone", pretrained=True)
    other = read("without", "finetune")
    assert all(other[name].equal(tensor) for name, tensor in read("with", "finetune").items())


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["updown=contrastive", "model=baseline_bn_relu"], "updown.iterations = 10"),
        (["updown=contrastive", "updown.labels=1"], "updown.labels = 1"),
        (["updown=contrastive", "updown.visible=mode"], "visible = 'mode'"),
        (["updown.iterations=-1"], "updown.iterations = -1"),
        (["updown=contrastive", "+updown.rate=1"], "setting updown = 'rate'"),
    ],
)
def test_what_cannot_be_trained_is_refused(
    memcomp_train: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, overrides: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    outcome = memcomp_train(*COMMAND[:-1], *overrides)
    assert outcome.status != 0
    assert said in outcome.err
    assert "Traceback" not in outcome.err
