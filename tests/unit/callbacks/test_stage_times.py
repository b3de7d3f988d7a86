"""Seconds of a stage, by a clock that the test moves."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from foreign import TheirRBM, events_in, fit, tensorboard
from lightning.pytorch.loggers import CSVLogger

from memcomp_lightning.callbacks import StageTimes, stage_times
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import Greedy
from memcomp_lightning.types import Batch

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(stage_times, "time", SimpleNamespace(perf_counter=clock.perf_counter))
    return clock


class Slow(TheirRBM):
    """A second a training step, a quarter a validation step."""

    def __init__(self, clock: Clock) -> None:
        super().__init__()
        self.clock = clock

    def training_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        self.clock.now += 1
        return super().training_step(batch, batch_idx)

    def validation_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        self.clock.now += 0.25
        return super().validation_step(batch, batch_idx)


class SlowCallback(pl.Callback):
    """Ten seconds a pass."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if trainer.is_last_batch:
            self.clock.now += 10


def test_seconds_are_where_they_were_spent_and_in_every_logger(tmp_path: Path, clock: Clock) -> None:
    times = StageTimes()
    loggers = [tensorboard(tmp_path / "board"), CSVLogger(tmp_path, name="csv")]
    fit(tmp_path, [times, SlowCallback(clock)], loggers, Slow(clock))
    # Three passes of four batches each.
    assert times.summary == {"Slow": {"training_s": 12.0, "validation_s": 3.0, "other_s": 30.0}}
    events = events_in(tmp_path / "board")
    assert events.Scalars("Slow/seconds/other_s")[-1].value == 30
    (text,) = events.Tensors("Slow/seconds/text_summary")
    assert b"| Slow | 12.00 | 3.00 | 30.00 | 45.00 |" in text.tensor_proto.string_val[0]
    assert "Slow/seconds/validation_s" in (tmp_path / "csv/version_0/metrics.csv").read_text()


def test_a_resumed_run_adds_up(tmp_path: Path, clock: Clock) -> None:
    _, trainer = fit(tmp_path, [StageTimes(), SlowCallback(clock)], module=Slow(clock), n_passes=1)
    trainer.save_checkpoint(tmp_path / "half.ckpt")
    clock.now += 1000  # nobody trains
    times = StageTimes()
    callbacks = [times, SlowCallback(clock)]
    fit(tmp_path, callbacks, module=Slow(clock), n_passes=3, resume_from=tmp_path / "half.ckpt")
    assert times.summary == {"Slow": {"training_s": 12.0, "validation_s": 3.0, "other_s": 30.0}}


def test_layers_have_times_of_their_own(tmp_path: Path, clock: Clock) -> None:
    class SlowLayers(EnergyPretraining):
        def training_step(self, batch: Any, batch_idx: int) -> dict[str, Any]:
            clock.now += self.layer + 1
            images = batch[0]
            return super().training_step(Batch(images, images[:, 0].long(), 1.0, True), batch_idx)

        def validation_step(self, batch: Any, batch_idx: int) -> dict[str, Any]:
            return {"v": batch[0]}

    class Saves(pl.Callback):
        def on_train_epoch_end(self, *_: Any) -> None:
            clock.now += 5

    times = StageTimes()
    fit(tmp_path, [times, Saves()], module=SlowLayers(Greedy(DBN(6, [4, 3])), CD(), iterations=1), n_passes=2)
    assert times.summary == {
        "pretrain/layer1": {"training_s": 4.0, "validation_s": 0.0, "other_s": 5.0},
        "pretrain/layer2": {"training_s": 8.0, "validation_s": 0.0, "other_s": 5.0},
    }
