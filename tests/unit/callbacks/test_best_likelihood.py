"""Energy models that end with the weights at which held-out rows were most likely, and chains that stop mixing."""

import logging
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.callbacks import BestLikelihood, LogLikelihood
from memcomp_lightning.data import TableDataModule
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import CD, PCD
from memcomp_lightning.training import Greedy

pytestmark = pytest.mark.filterwarnings("ignore:.*does not have many workers.*")
ROWS = rng.bernoulli(torch.full((60, 6), 0.4), generator=rng.stream(3, "rows"))
ROWS[:, 1] = ROWS[:, 0]


def fitted(
    folder: Path,
    callback: pl.Callback,
    *,
    sizes: tuple[int, ...] = (4,),
    rate: float = 2.0,
    sampler: Any = None,
    n_passes: int = 6,
    resume_from: Path | None = None,
    also: Sequence[pl.Callback] = (),
) -> tuple[EnergyPretraining, pl.Trainer, TableDataModule]:
    data = TableDataModule.from_array(ROWS.numpy(), validation_fraction=0.4, batch_size=6, test_fraction=0.1)
    dbn = DBN(6, list(sizes), generator=rng.stream(0, "weights"))
    module = EnergyPretraining(
        Greedy(dbn), sampler or CD(k=1), iterations=n_passes, optimizer=partial(SGD, lr=rate), seed=1
    )
    trainer = pl.Trainer(
        max_epochs=module.n_epochs,
        accelerator="cpu",
        logger=False,
        callbacks=[callback, *also],
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=False,
        num_sanity_val_steps=0,
        default_root_dir=folder,
    )
    trainer.fit(module, datamodule=data, ckpt_path=resume_from, weights_only=True)
    return module, trainer, data


def heldout(model: Any, data: TableDataModule) -> float:
    log_z = log_partition_function(model)
    return float(log_likelihood(model, data.heldout[0], log_z).mean())


def test_a_model_ends_with_the_weights_of_its_best_look(tmp_path: Path) -> None:
    callback = BestLikelihood(every=1)
    module, _, data = fitted(tmp_path, callback)
    values = [value["heldout"][0] for value in callback.history]
    assert len(values) == 6
    assert max(values) > values[-1]  # the last weights are not the best here
    assert heldout(module.models[0], data) == pytest.approx(max(values), abs=1e-4)


def test_each_layer_has_its_own_and_training_stops_without_patience(tmp_path: Path) -> None:
    callback = BestLikelihood(every=1, patience=2)
    module, _, data = fitted(tmp_path, callback, sizes=(4, 3), n_passes=12)
    first = [value["heldout"][0] for value in callback.history if value["layer"] == 0]
    second = [value for value in callback.history if value["layer"] == 1]
    assert second
    assert len(first) == first.index(max(first)) + 3 < 12
    assert heldout(module.models[0], data) == pytest.approx(max(first), abs=1e-4)


def test_a_run_that_goes_on_keeps_what_was_best_before(tmp_path: Path) -> None:
    whole, _, _ = fitted(tmp_path, BestLikelihood(every=1))

    class Stop(pl.Callback):
        def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            if trainer.current_epoch == 3:
                trainer.save_checkpoint(tmp_path / "half.ckpt")

    fitted(tmp_path, BestLikelihood(every=1), also=[Stop()])
    again, _, _ = fitted(tmp_path, BestLikelihood(every=1), resume_from=tmp_path / "half.ckpt")
    for a, b in zip(whole.models[0].parameters(), again.models[0].parameters(), strict=True):
        assert a.equal(b)


def test_a_model_without_a_likelihood_keeps_its_newest_weights(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("memcomp_lightning.callbacks.log_likelihood.QUICKLY_ENUMERATED", 1)
    monkeypatch.setattr("memcomp_lightning.callbacks.log_likelihood.QUICKLY_ANNEALED", 1)
    with caplog.at_level(logging.INFO):
        chosen, _, _ = fitted(tmp_path, BestLikelihood(every=1))
    plain, _, _ = fitted(tmp_path, LogLikelihood(every=1))
    assert "the newest weights stay" in caplog.text
    for a, b in zip(chosen.models[0].parameters(), plain.models[0].parameters(), strict=True):
        assert a.equal(b)


@pytest.mark.parametrize("method", ["exact", "ais"])
def test_chains_in_a_mode_of_little_weight_are_behind(method: str) -> None:
    """All on has a hundredth of the weight of all off; annealing reaches both."""
    rbm = RBM(6, 1)
    with torch.no_grad():
        rbm.weight.fill_(8.0)
        rbm.c.fill_(-24.0)
        rbm.b.fill_(-4.0 - math.log(100) / 6)
    on, off = torch.ones(50, 6), torch.zeros(50, 6)
    callback = LogLikelihood(method=method, n_betas=300, n_chains=400)

    def gap(chains: torch.Tensor) -> float:
        return float(callback._partition_function(rbm, method, torch.cat([on, off]), None, chains)["log_z_gap"])

    assert gap(torch.cat([off] * 99 + [on])) == pytest.approx(0.0, abs=0.15)
    assert gap(on) > 2


class Given(LogLikelihood):
    """Finds gaps that are given, one a look."""

    def __init__(self, gaps: list[float]) -> None:
        super().__init__(every=1)
        self.gaps = iter(gaps)

    def _partition_function(self, *arguments: Any) -> dict[str, torch.Tensor]:
        found = super()._partition_function(*arguments)
        assert "log_z_gap" in found
        return {**found, "log_z_gap": torch.tensor(next(self.gaps), dtype=torch.float64)}


@pytest.mark.parametrize(
    ("gaps", "at"),
    [
        ([0.2, 3.0, 0.1, 3.0, 0.0], None),  # chains that fall behind and come back
        ([0.2, 3.0, 2.0, 3.0, 0.0], "pass 3"),
        ([0.0, 0.0, 0.0, 0.0, 1.5], "pass 5"),  # the last one
        ([-3.0, -3.0, -3.0, -3.0, -3.0], None),
    ],
)
def test_a_warning_names_the_remedy_where_chains_stay_behind(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, gaps: list[float], at: str | None
) -> None:
    callback = Given(gaps)
    with caplog.at_level(logging.WARNING):
        fitted(tmp_path, callback, sampler=PCD(n_chains=20), rate=0.05, n_passes=5)
    assert [value["gap"] for value in callback.history] == [[gap] for gap in gaps]
    said = [record.getMessage() for record in caplog.records if "stopped mixing" in record.getMessage()]
    assert len(said) == (at is not None)
    if at is not None:
        assert said[0].startswith(f"pretrain/layer1, {at}: ")
        assert "pretrain=falling" in said[0]
        assert "sampler=tempering" in said[0]


def test_without_chains_there_is_no_gap(tmp_path: Path) -> None:
    callback = LogLikelihood(every=1)
    fitted(tmp_path, callback, sampler=CD(k=1), n_passes=2)
    assert all(value["gap"] == [] for value in callback.history)


def test_chains_that_are_behind_do_not_change_an_exact_likelihood(tmp_path: Path) -> None:
    class Behind(BestLikelihood):
        def _partition_function(self, *arguments: Any) -> dict[str, torch.Tensor]:
            found = super()._partition_function(*arguments)
            return {**found, "log_z_gap": torch.tensor(-1e3 / (1 + len(self.history)), dtype=torch.float64)}

    callback = Behind(every=1)
    module, _, data = fitted(tmp_path, callback, sampler=PCD(n_chains=20))
    values = [value["heldout"][0] for value in callback.history]
    assert max(values) > values[-1]
    assert heldout(module.models[0], data) == pytest.approx(max(values), abs=1e-4)
