"""Every callback works with a LightningModule that is not ours, and leaves its training alone."""

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch.utils.data import DataLoader, TensorDataset

from memcomp_lightning import rng
from memcomp_lightning.callbacks import (
    ClassificationMetrics,
    FreeEnergyGap,
    HyperParameters,
    ModelSamples,
    MomentumSchedule,
    NegativePhaseEnergies,
    OptimizerMonitor,
    ParameterHistograms,
    ReceptiveFields,
    ReconstructionError,
    StageProgressBar,
)
from memcomp_lightning.callbacks.base import rbm_of
from memcomp_lightning.data import PixelLayout
from memcomp_lightning.models import RBM, Gaussian
from memcomp_lightning.modules import Score
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import CD, positive_phase

PREFIX = "TheirRBM"


class TheirRBM(pl.LightningModule):
    """Somebody else's module: automatic optimisation, torch's own loaders, the documented protocol."""

    def __init__(self) -> None:
        super().__init__()
        self.rbm = RBM(6, 5, weight_init=Gaussian(std=0.3))
        self.their_generator = rng.stream(1, "theirs")

    def training_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        v = batch[0]
        positive = positive_phase(self.rbm, v)
        sampler = CD(k=1)
        state = sampler.init(self.rbm, len(v), generator=self.their_generator)
        negative = sampler.sample(self.rbm, state, positive, generator=self.their_generator)
        gap = contrast(self.rbm, positive, negative.configurations)
        score = Score(gap.detach(), torch.tensor(3), len(v))
        return {
            "loss": gap,
            "contrast": gap.detach(),
            "positive": positive,
            "negative": negative.configurations,
            "info": {"temperature": torch.tensor(1.0)},
            "score": score,
        }

    def validation_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        return {"v": batch[0], "score": Score(torch.tensor(2.0), torch.tensor(1), len(batch[0]))}

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1, momentum=0.9)


class TheirData(pl.LightningDataModule):
    pixel_layout = PixelLayout(2, 3)

    def _loader(self) -> DataLoader[Any]:
        return DataLoader(TensorDataset(rng.uniform((17, 6), generator=rng.stream(0, "data"))), batch_size=5)

    def train_dataloader(self) -> DataLoader[Any]:
        return self._loader()

    def val_dataloader(self) -> DataLoader[Any]:
        return self._loader()


def all_callbacks() -> list[pl.Callback]:
    return [
        ReconstructionError(),
        FreeEnergyGap(n_images=7),
        NegativePhaseEnergies(),
        OptimizerMonitor(),
        ParameterHistograms(every=1),
        ReceptiveFields(every=1, n_units=4),
        ModelSamples(every=1, n_samples=4, n_sweeps=3),
        ClassificationMetrics(),
        HyperParameters({"model": {"n_hidden": 5}}, metrics=[f"{PREFIX}/reconstruction_error", "not_logged"]),
        StageProgressBar(),
    ]


def fit(folder: Path, callbacks: list[pl.Callback], logger: Any) -> tuple[TheirRBM, pl.Trainer]:
    module = TheirRBM()
    trainer = pl.Trainer(
        max_epochs=3,
        accelerator="cpu",
        logger=logger,
        callbacks=callbacks,
        enable_checkpointing=False,
        enable_model_summary=False,
        enable_progress_bar=any(isinstance(callback, StageProgressBar) for callback in callbacks),
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        default_root_dir=folder,
    )
    trainer.fit(module, datamodule=TheirData())
    return module, trainer


pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]


def test_tensorboard_holds_everything(tmp_path: Path) -> None:
    fit(tmp_path, all_callbacks(), TensorBoardLogger(tmp_path, name="", version="", default_hp_metric=False))
    events = EventAccumulator(str(tmp_path), size_guidance={"images": 0, "scalars": 0, "histograms": 0})
    events.Reload()
    tags = events.Tags()
    scalars = {
        "reconstruction_error",
        "free_energy_train",
        "free_energy_heldout",
        "free_energy_gap",
        "energy_data",
        "energy_model",
        "energy_model_lowest",
        "contrast",
        "negative_phase/temperature",
        "learning_rate",
        "momentum",
        "loss",
        "accuracy",
        "heldout_loss",
        "heldout_accuracy",
    }
    assert {f"{PREFIX}/{name}" for name in scalars} <= set(tags["scalars"])
    assert set(tags["images"]) == {f"{PREFIX}/receptive_fields", f"{PREFIX}/samples"}
    histograms = {"weight", "b", "c", "energies_data", "energies_model"}
    assert {f"{PREFIX}/{name}" for name in histograms} <= set(tags["histograms"])
    assert len(events.Scalars(f"{PREFIX}/reconstruction_error")) == 3
    assert len(events.Images(f"{PREFIX}/samples")) == 3
    assert events.Scalars(f"{PREFIX}/momentum")[0].value == pytest.approx(0.9)
    assert events.Scalars(f"{PREFIX}/accuracy")[0].value == pytest.approx(3 * 4 / 17)
    hparams = [path for path in tmp_path.rglob("events.out.*") if b"n_hidden" in path.read_bytes()]
    assert hparams, "settings are in the HParams tab"


def test_values_are_what_they_claim(tmp_path: Path) -> None:
    module, trainer = fit(tmp_path, all_callbacks(), False)
    v = rng.uniform((17, 6), generator=rng.stream(0, "data"))
    with torch.no_grad():
        rbm, logged = module.rbm, trainer.callback_metrics
        last = v[15:]
        error = (last - rbm.visible_mean(rbm.hidden_mean(last))).square().mean()
        assert logged[f"{PREFIX}/reconstruction_error"] == pytest.approx(float(error), rel=1e-5)
        heldout = rbm.free_energy(v).mean()
        assert logged[f"{PREFIX}/free_energy_heldout"] == pytest.approx(float(heldout), rel=1e-5)
        train = rbm.free_energy(v[10:]).mean()  # the last batches that hold at least seven images
        assert logged[f"{PREFIX}/free_energy_train"] == pytest.approx(float(train), rel=1e-5)


def test_callbacks_change_no_bit_of_training(tmp_path: Path) -> None:
    watched, _ = fit(tmp_path, all_callbacks(), CSVLogger(tmp_path, name="csv"))
    alone, _ = fit(tmp_path, [], False)
    assert all(a.equal(b) for a, b in zip(watched.parameters(), alone.parameters(), strict=True))
    assert "energy_model" in (tmp_path / "csv/version_0/metrics.csv").read_text()


def test_momentum_schedule_counts_epochs_of_a_foreign_module(tmp_path: Path) -> None:
    _, trainer = fit(tmp_path, [MomentumSchedule(0.1, 0.7, switch_at=2)], False)
    assert trainer.optimizers[0].param_groups[0]["momentum"] == 0.7


def test_a_module_without_an_rbm_is_told_so() -> None:
    with pytest.raises(TypeError, match=r"LightningModule has no attribute 'rbm'.*protocol"):
        rbm_of(pl.LightningModule())


@pytest.mark.parametrize(("callback", "missing"), [(ReconstructionError(), "positive"), (FreeEnergyGap(), "v")])
def test_a_module_without_the_protocol_is_told_what_is_missing(
    tmp_path: Path, callback: pl.Callback, missing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = {"positive": TheirRBM.training_step, "v": TheirRBM.validation_step}[missing]

    def without(self: TheirRBM, batch: Any, batch_idx: int) -> dict[str, Any]:
        outputs = original(self, batch, batch_idx)
        del outputs[missing]
        return outputs

    monkeypatch.setattr(TheirRBM, "training_step" if missing == "positive" else "validation_step", without)
    with pytest.raises(TypeError, match=f"needs '{missing}' in the dictionary"):
        fit(tmp_path, [callback], False)
