"""Every callback works with a LightningModule that is not ours, and leaves its training alone."""

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from foreign import IMAGES, PREFIX, TheirChains, TheirRBM, blank, events_in, fit, tensorboard
from lightning.pytorch.loggers import CSVLogger

from memcomp_lightning.callbacks import (
    ChainPictures,
    ClassificationMetrics,
    Densities,
    EnergyHistograms,
    FreeEnergyGap,
    FreeEnergyHistograms,
    GradientBias,
    HyperParameters,
    Logos,
    ModelSamples,
    NegativePhaseEnergies,
    OptimizerMonitor,
    ParameterHistograms,
    ReceptiveFields,
    ReconstructionError,
    SamplerDiagnostics,
    SamplesAgainstData,
    SaturationGuard,
    Schedules,
    StageProgressBar,
    StageTimes,
    StateFrequencies,
    StateWeights,
    TrajectoryFigure,
    against_samples,
)
from memcomp_lightning.callbacks.base import model_of
from memcomp_lightning.training import MomentumSchedule


@pytest.fixture(autouse=True)
def _no_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(against_samples, "rendered", blank)


def all_callbacks() -> list[pl.Callback]:
    return [
        StageTimes(),
        ReconstructionError(),
        FreeEnergyGap(n_images=7),
        NegativePhaseEnergies(),
        SamplerDiagnostics(),
        EnergyHistograms(every=1),
        GradientBias(every=1),
        OptimizerMonitor(),
        ParameterHistograms(every=1),
        ReceptiveFields(every=1, n_units=4),
        ModelSamples(every=1, n_samples=4, n_sweeps=3),
        ChainPictures(every=1, n_chains=4),
        StateFrequencies(every=1, n_samples=4, n_sweeps=3),
        StateWeights(every=1),
        Logos(every=1, n_samples=4, n_sweeps=3),
        Densities(every=1, n_samples=4, n_sweeps=3),
        SamplesAgainstData(every=1, n_samples=4, n_sweeps=3, n_panels=2),
        FreeEnergyHistograms(every=1, n_samples=4, n_sweeps=3),
        TrajectoryFigure(every=1),
        SaturationGuard(),
        ClassificationMetrics(),
        HyperParameters({"model": {"n_hidden": 5}}, metrics=[f"{PREFIX}/reconstruction_error", "not_logged"]),
        StageProgressBar(),
    ]


pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]


def test_tensorboard_holds_everything(tmp_path: Path) -> None:
    fit(tmp_path, all_callbacks(), tensorboard(tmp_path))
    events = events_in(tmp_path)
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
        "negative_phase/bits_changed",
        "negative_phase/autocorrelation_time",
        "gradient_bias/cosine",
        "gradient_bias/relative_error",
        "seconds/training_s",
        "seconds/validation_s",
        "seconds/other_s",
        "learning_rate",
        "momentum",
        "loss",
        "accuracy",
        "heldout_loss",
        "heldout_accuracy",
    }
    assert {f"{PREFIX}/{name}" for name in scalars} <= set(tags["scalars"])
    pictures = {"receptive_fields", "samples", "chains", "energies", "trajectory", "free_energies"}
    pictures |= {"marginals", "correlations", "plane"}
    assert set(tags["images"]) == {f"{PREFIX}/{name}" for name in pictures}
    histograms = {"weight", "b", "c", "energies_data", "energies_model"}
    assert {f"{PREFIX}/{name}" for name in histograms} <= set(tags["histograms"])
    assert len(events.Scalars(f"{PREFIX}/reconstruction_error")) == 3
    assert all(len(events.Images(tag)) == 3 for tag in tags["images"])
    assert events.Scalars(f"{PREFIX}/momentum")[0].value == pytest.approx(0.9)
    assert events.Scalars(f"{PREFIX}/accuracy")[0].value == pytest.approx(3 * 4 / 17)
    hparams = [path for path in tmp_path.rglob("events.out.*") if b"n_hidden" in path.read_bytes()]
    assert hparams, "settings are in the HParams tab"


def test_values_are_what_they_claim(tmp_path: Path) -> None:
    module, trainer = fit(tmp_path, all_callbacks(), False)
    v = IMAGES
    with torch.no_grad():
        rbm, logged = module.model, trainer.callback_metrics
        last = v[15:]
        error = (last - rbm.visible_mean(rbm.hidden_mean(last))).square().mean()
        assert logged[f"{PREFIX}/reconstruction_error"] == pytest.approx(float(error), rel=1e-5)
        heldout = rbm.free_energy(v[:7]).mean()
        assert logged[f"{PREFIX}/free_energy_heldout"] == pytest.approx(float(heldout), rel=1e-5)
        train = rbm.free_energy(v[10:]).mean()  # the last batches that hold at least seven images
        assert logged[f"{PREFIX}/free_energy_train"] == pytest.approx(float(train), rel=1e-5)
        assert logged[f"{PREFIX}/free_energy_gap"] == pytest.approx(float(heldout - train), rel=1e-4)


@pytest.mark.parametrize("kind", [TheirRBM, TheirChains])
@pytest.mark.parametrize("board", [True, False])
def test_callbacks_change_no_bit_of_training(tmp_path: Path, kind: type[TheirRBM], board: bool) -> None:
    callbacks = [c for c in all_callbacks() if kind is TheirRBM or not isinstance(c, ClassificationMetrics)]
    loggers = [CSVLogger(tmp_path, name="csv"), *[tensorboard(tmp_path)] * board]
    watched, _ = fit(tmp_path, callbacks, loggers, kind())
    alone, _ = fit(tmp_path, [], False, kind())
    assert all(a.equal(b) for a, b in zip(watched.parameters(), alone.parameters(), strict=True))
    if kind is TheirRBM:
        written = (tmp_path / "csv/version_0/metrics.csv").read_text()
        assert "energy_model" in written
        assert "seconds/training_s" in written


def test_momentum_schedule_counts_epochs_of_a_foreign_module(tmp_path: Path) -> None:
    _, trainer = fit(tmp_path, [Schedules(MomentumSchedule(0.1, 0.7, switch_at=2))], False)
    assert trainer.optimizers[0].param_groups[0]["momentum"] == 0.7


def test_a_module_without_an_energy_model_is_told_so() -> None:
    module: Any = pl.LightningModule()
    with pytest.raises(TypeError, match=r"LightningModule has no attribute 'model'.*protocol"):
        model_of(module)
    module.model = torch.nn.Linear(2, 3)
    with pytest.raises(TypeError, match=r"LightningModule has a Linear as its 'model'.*protocol"):
        model_of(module)


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
