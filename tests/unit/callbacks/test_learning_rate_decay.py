"""A learning rate that falls, in a module that is not ours and in the loops without a trainer."""

from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
from foreign import TheirData, TheirRBM

from memcomp_lightning.callbacks import Schedules
from memcomp_lightning.errors import SettingError
from memcomp_lightning.training import LearningRateDecay

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]


class Seen(pl.Callback):
    def __init__(self) -> None:
        self.rates: list[float] = []

    def on_train_batch_start(self, trainer: pl.Trainer, *args: object) -> None:
        self.rates.append(trainer.optimizers[0].param_groups[0]["lr"])


def rates_of(folder: Path, n_passes: int, resume_from: Path | None = None) -> list[float]:
    seen = Seen()
    trainer = pl.Trainer(
        max_epochs=n_passes,
        accelerator="cpu",
        logger=False,
        callbacks=[Schedules(LearningRateDecay(4, final=0.1)), seen],
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=False,
        limit_train_batches=1,
        limit_val_batches=0,
        default_root_dir=folder,
    )
    trainer.fit(TheirRBM(), datamodule=TheirData(), ckpt_path=resume_from, weights_only=True)
    trainer.save_checkpoint(folder / "last.ckpt")
    return seen.rates


def test_rate_falls_linearly_and_goes_on_after_a_resume(tmp_path: Path) -> None:
    expected = [0.1, 0.07, 0.04, 0.01, 0.01]
    assert rates_of(tmp_path, 5) == pytest.approx(expected)
    assert rates_of(tmp_path, 2) == pytest.approx(expected[:2])
    assert rates_of(tmp_path, 5, tmp_path / "last.ckpt") == pytest.approx(expected[2:])


def test_the_loop_without_a_trainer_does_the_same() -> None:
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
    schedule = LearningRateDecay(4, final=0.1)
    found = []
    for iteration in range(5):
        schedule.begin_pass(optimizer, iteration)
        found.append(optimizer.param_groups[0]["lr"])
    assert found == pytest.approx([0.1, 0.07, 0.04, 0.01, 0.01])


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingError, match="n_passes = 0"):
        LearningRateDecay(0)
    with pytest.raises(SettingError, match="final = 0"):
        LearningRateDecay(3, final=0)
