"""The weights of the best pass, a pass of its own for each replica."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from torch.utils.data import DataLoader, TensorDataset

from memcomp_lightning.callbacks import BestWeights
from memcomp_lightning.errors import SettingError
from memcomp_lightning.training import BestPass, Score

N_CORRECT = torch.tensor([[3, 5], [7, 2], [7, 8], [1, 8]])
"""Of ten held-out images, by pass and replica."""


class Counter(pl.LightningModule):
    """Its weight is the number of the pass, for both replicas."""

    def __init__(self, replicas: tuple[int, ...] = (2,)) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(*replicas, 3))
        self.register_buffer("seen", torch.zeros(replicas))
        self.automatic_optimization = False

    def training_step(self, batch: Any, batch_idx: int) -> None:
        with torch.no_grad():
            self.weight += 1
            self.seen += 1

    def validation_step(self, batch: Any, batch_idx: int) -> dict[str, Any]:
        n_correct = N_CORRECT[self.current_epoch]
        if self.weight.ndim == 1:
            n_correct = n_correct[0]
        return {"score": Score(10 * n_correct.float(), n_correct, 10)}

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def fit(
    module: Counter,
    folder: Path,
    n_passes: int,
    resume_from: Path | None = None,
    also: Sequence[pl.Callback] = (),
    **judging: Any,
) -> Any:
    loader = DataLoader(TensorDataset(torch.zeros(1, 1)))
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False}
    trainer = pl.Trainer(
        max_epochs=n_passes,
        accelerator="cpu",
        logger=False,
        callbacks=[BestWeights(**judging), *also],
        num_sanity_val_steps=1,
        default_root_dir=folder,
        **quiet,
    )
    trainer.fit(module, loader, loader, ckpt_path=resume_from, weights_only=True)
    return trainer


pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]


def test_each_replica_ends_with_its_best_pass(tmp_path: Path) -> None:
    module = Counter()
    fit(module, tmp_path, 4)
    assert module.weight.tolist() == [[2, 2, 2], [3, 3, 3]]  # the first of equal passes
    assert module.seen.tolist() == [2, 3]
    alone = Counter(replicas=())
    fit(alone, tmp_path, 4)
    assert alone.weight.tolist() == [2, 2, 2]


def test_the_best_pass_before_an_interruption_counts(tmp_path: Path) -> None:
    class StoppedError(Exception):
        pass

    class Fails(Counter):
        def on_train_epoch_start(self) -> None:
            if self.current_epoch == 2:
                self.trainer.save_checkpoint(tmp_path / "last.ckpt")
                raise StoppedError

    with pytest.raises(StoppedError):
        fit(Fails(), tmp_path, 4)
    module = Counter()
    fit(module, tmp_path, 4, tmp_path / "last.ckpt")
    assert module.weight.tolist() == [[2, 2, 2], [3, 3, 3]]


def test_a_run_that_stopped_after_its_last_pass_ends_with_the_best_one(tmp_path: Path) -> None:
    class KeepsLast(pl.Callback):
        def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            trainer.save_checkpoint(tmp_path / "last.ckpt")

    last = fit(Counter(), tmp_path, 4, also=[KeepsLast()])
    assert last.current_epoch == 4
    module = Counter()
    fit(module, tmp_path, 4, tmp_path / "last.ckpt")
    assert module.weight.tolist() == [[2, 2, 2], [3, 3, 3]]


def test_patience_ends_training_and_a_replica_out_of_it_takes_no_later_pass(tmp_path: Path) -> None:
    module = Counter()
    trainer = fit(module, tmp_path, 4, patience=1)
    assert trainer.current_epoch == 3
    assert module.weight.tolist() == [[2, 2, 2], [1, 1, 1]]
    patient = Counter()
    assert fit(patient, tmp_path, 4, patience=2).current_epoch == 4
    assert patient.weight.tolist() == [[2, 2, 2], [3, 3, 3]]


def test_a_lower_loss_may_be_what_is_better(tmp_path: Path) -> None:
    module = Counter()
    fit(module, tmp_path, 4, by="loss")
    assert module.weight.tolist() == [[4, 4, 4], [2, 2, 2]]
    with pytest.raises(SettingError, match=r"finetune.best_by = 'auc' .*'accuracy', 'loss'"):
        BestWeights(by="auc")


@pytest.mark.parametrize("at", [1, 2, 3])
def test_patience_counts_the_passes_before_an_interruption(tmp_path: Path, at: int) -> None:
    class StoppedError(Exception):
        pass

    class Fails(pl.Callback):
        def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            if trainer.current_epoch == at - 1:
                trainer.save_checkpoint(tmp_path / "last.ckpt")
                raise StoppedError

    with pytest.raises(StoppedError):
        fit(Counter(), tmp_path, 4, also=[Fails()], patience=1)
    module = Counter()
    fit(module, tmp_path, 4, tmp_path / "last.ckpt", patience=1)
    assert module.weight.tolist() == [[2, 2, 2], [1, 1, 1]]


def test_waiting_begins_anew_by_more_than_the_tolerance_alone() -> None:
    best = BestPass(patience=2, tolerance=0.1)
    for number, value in enumerate([0.5, 0.55, 0.58]):
        assert not best.over
        best.offer(torch.tensor(value), {"weight": torch.tensor(float(number))})
    assert best.over
    assert best.weights["weight"] == 2
    with pytest.raises(SettingError, match=r"patience = 0"):
        BestPass(patience=0)
