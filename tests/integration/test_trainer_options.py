"""Every argument of Lightning's trainer, every callback of Lightning: taken, or refused before anything trains."""

import inspect
import json
from collections.abc import Callable, Iterator
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from lightning.pytorch import callbacks
from running import Outcome

from memcomp_lightning.callbacks import ReconstructionError
from memcomp_lightning.data import ImageDataModule, ShiftingBars
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, Linear
from memcomp_lightning.modules import Classifier, EnergyPretraining, NotTrainedError, StageModule
from memcomp_lightning.modules.trainers import check_callback
from memcomp_lightning.samplers import CD, PCD
from memcomp_lightning.training import Greedy

Run = Callable[..., Outcome]
WHOLE = ["pretrain.batch_size=null", "finetune.batch_size=null"]
SHORT = [
    *("sampler=cd", "pretrain.iterations=2", "finetune.iterations=2", "callbacks=minimal", "logger=none"),
    *WHOLE,
]

REFUSED: dict[str, Any] = {
    "logger": "false",
    "callbacks": "[]",
    "max_epochs": 3,
    "max_steps": 7,
    "min_steps": 2,
    "limit_train_batches": 2,
    "limit_test_batches": 1,
    "limit_predict_batches": 1,
    "overfit_batches": 2,
    "num_sanity_val_steps": 1,
    "enable_model_summary": "true",
    "accumulate_grad_batches": 2,
    "gradient_clip_val": 1,
    "gradient_clip_algorithm": "norm",
    "use_distributed_sampler": "true",
    "barebones": "true",
    "plugins": "[]",
    "sync_batchnorm": "true",
    "default_root_dir": "here",
    "model_registry": "mine",
}
"""Never the user's to set."""

HARMLESS: dict[str, Any] = {
    "accelerator": "cpu",
    "strategy": "auto",
    "devices": 1,
    "num_nodes": 1,
    "precision": 32,
    "fast_dev_run": "false",
    "min_epochs": 1,
    "max_time": "01:00:00:00",
    "limit_val_batches": 1.0,
    "val_check_interval": 0.5,
    "check_val_every_n_epoch": 1,
    "log_every_n_steps": 3,
    "enable_checkpointing": "true",
    "enable_progress_bar": "true",
    "deterministic": "true",
    "benchmark": "false",
    "inference_mode": "false",
    "profiler": "simple",
    "detect_anomaly": "true",
    "reload_dataloaders_every_n_epochs": 1,
    "enable_autolog_hparams": "false",
}
"""Taken, and these values do not change what is learned."""

OUT_OF_RANGE = [
    "trainer.limit_train_batches=0.1",
    "trainer.limit_val_batches=1",
    "trainer.enable_checkpointing=false",
    "trainer.enable_progress_bar=false",
    "trainer.check_val_every_n_epoch=0",
    "trainer.val_check_interval=99",
    "trainer.strategy=ddp_spawn",
    "trainer.profiler=mine",
    "trainer.min_epochs=-1",
    "trainer.precision=bf16",
    "trainer.precision=16",
    "trainer.precision=bf16-mixed",
    "trainer.precision=transformer-engine",
    "trainer.precision=float32",
    "trainer.limit_train_batch=1.0",
]


@pytest.fixture
def any_algorithm() -> Iterator[None]:
    """``deterministic=true`` is a setting of the process."""
    yield
    torch.use_deterministic_algorithms(False)


@pytest.fixture
def plain_run(memcomp_train: Run) -> Any:
    assert memcomp_train(*SHORT, "hydra.run.dir=plain").status == 0
    return torch.load("plain/weights/finetune.pt", weights_only=True)


def test_every_argument_of_the_trainer_is_known() -> None:
    assert {*REFUSED, *HARMLESS} == {*inspect.signature(pl.Trainer).parameters}


@pytest.mark.parametrize("given", [*(f"trainer.{name}={value}" for name, value in REFUSED.items()), *OUT_OF_RANGE])
def test_is_refused_before_anything_trains(memcomp_train: Run, given: str) -> None:
    outcome = memcomp_train(*SHORT, f"++{given}", "hydra.run.dir=run")
    assert outcome.status == 2
    assert len(outcome.err.splitlines()) == 1
    name = given.partition("=")[0].removeprefix("trainer.")
    assert name in outcome.err
    assert not Path("run").exists()


@pytest.mark.usefixtures("any_algorithm")
def test_harmless_arguments_change_nothing(memcomp_train: Run, plain_run: Any) -> None:
    given = [f"++trainer.{name}={value}" for name, value in HARMLESS.items()]
    outcome = memcomp_train(*SHORT, *given, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    found = torch.load("run/weights/finetune.pt", weights_only=True)
    torch.testing.assert_close(found, plain_run, rtol=0, atol=0)
    assert "run_training_epoch" in Path("run/checkpoints/pretrain/fit-profile.txt").read_text()


def test_values_that_are_the_defaults_are_no_fault(memcomp_train: Run) -> None:
    defaults = ["limit_train_batches=1.0", "overfit_batches=0.0", "gradient_clip_val=null", "max_steps=-1"]
    given = [f"+trainer.{default}" for default in defaults]
    assert memcomp_train(*SHORT, *given, "hydra.run.dir=run").status == 0


@pytest.mark.parametrize(("precision", "dtype"), [(64, "float64"), ("32", "float32"), ("bf16-true", "bfloat16")])
def test_a_precision_is_that_of_the_weights(memcomp_train: Run, precision: Any, dtype: str) -> None:
    outcome = memcomp_train(*SHORT, f"trainer.precision={precision}", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    weights = torch.load("run/weights/finetune.pt", weights_only=True)
    assert {str(tensor.dtype) for tensor in weights.values()} == {f"torch.{dtype}"}


REFUSED_CALLBACKS: dict[str, Callable[[], pl.Callback]] = {
    "BackboneFinetuning": callbacks.BackboneFinetuning,
    "BatchSizeFinder": callbacks.BatchSizeFinder,
    "GradientAccumulationScheduler": lambda: callbacks.GradientAccumulationScheduler({0: 2}),
    "LearningRateFinder": callbacks.LearningRateFinder,
    "ModelPruning": lambda: callbacks.ModelPruning("l1_unstructured"),
    "StochasticWeightAveraging": lambda: callbacks.StochasticWeightAveraging(swa_lrs=0.1),
}


class Freezes(callbacks.BaseFinetuning):
    """Nothing, at no time."""

    def freeze_before_training(self, pl_module: pl.LightningModule) -> None:
        pass

    def finetune_function(self, pl_module: pl.LightningModule, epoch: int, optimizer: Any) -> None:
        pass


HARMLESS_CALLBACKS: dict[str, Callable[[], pl.Callback]] = {
    "BaseFinetuning": Freezes,
    "BasePredictionWriter": callbacks.BasePredictionWriter,
    "Callback": callbacks.Callback,
    "Checkpoint": callbacks.Checkpoint,
    "DeviceStatsMonitor": lambda: callbacks.DeviceStatsMonitor(cpu_stats=False),
    "EarlyStopping": lambda: callbacks.EarlyStopping("pretrain/layer1/reconstruction_error", patience=99),
    "LambdaCallback": callbacks.LambdaCallback,
    "LearningRateMonitor": callbacks.LearningRateMonitor,
    "ModelCheckpoint": callbacks.ModelCheckpoint,
    "ModelSummary": callbacks.ModelSummary,
    "OnExceptionCheckpoint": lambda: callbacks.OnExceptionCheckpoint("."),
    "RichModelSummary": callbacks.RichModelSummary,
    "SpikeDetection": lambda: callbacks.SpikeDetection(rtol=1e9),
    "ThroughputMonitor": lambda: callbacks.ThroughputMonitor(batch_size_fn=lambda batch: len(batch.label)),
    "Timer": lambda: callbacks.Timer(timedelta(days=1)),
}
BARS: dict[str, Callable[[], pl.Callback]] = {
    "ProgressBar": callbacks.ProgressBar,
    "RichProgressBar": callbacks.RichProgressBar,
    "TQDMProgressBar": callbacks.TQDMProgressBar,
}
AT_WORK: dict[str, Callable[[], pl.Callback]] = {
    "EMAWeightAveraging": callbacks.EMAWeightAveraging,
    "WeightAveraging": callbacks.WeightAveraging,
}
"""Taken; what they do to the weights is what the user asks them for."""


def bars(**settings: Any) -> ImageDataModule:
    return ImageDataModule(ShiftingBars().load(), **{"batch_size": None, **settings})


def trained(module: StageModule, *added: pl.Callback, data: ImageDataModule | None = None, **settings: Any) -> Any:
    trainer = pl.Trainer(
        **{"max_epochs": module.n_epochs, "logger": False, "enable_checkpointing": False, **settings},
        accelerator="cpu",
        callbacks=list(added),
        enable_progress_bar=any(isinstance(callback, callbacks.ProgressBar) for callback in added),
        enable_model_summary=False,
    )
    trainer.fit(module, datamodule=data or bars())
    return module


def pretraining(iterations: int = 2, **settings: Any) -> EnergyPretraining:
    return EnergyPretraining(Greedy(DBN(9, [5, 3])), PCD(n_chains=7), iterations=iterations, **settings)


def test_every_callback_of_lightning_is_known() -> None:
    assert {*REFUSED_CALLBACKS, *HARMLESS_CALLBACKS, *BARS, *AT_WORK} == {*callbacks.__all__}


@pytest.mark.parametrize("name", REFUSED_CALLBACKS)
def test_a_callback_that_changes_updates_is_refused(name: str) -> None:
    with pytest.raises(SettingError, match=f"callback = '{name}' is not allowed"):
        check_callback(REFUSED_CALLBACKS[name]())
    with pytest.raises(SettingError, match=f"callback = '{name}'"):
        trained(pretraining(), REFUSED_CALLBACKS[name]())


def test_a_callback_that_is_refused_is_refused_on_the_command_line(memcomp_train: Run) -> None:
    finder = "+callbacks.finetune.x._target_=lightning.pytorch.callbacks.BatchSizeFinder"
    outcome = memcomp_train(*SHORT, finder, "hydra.run.dir=run")
    assert (outcome.status, Path("run").exists()) == (2, False)
    assert "callbacks.finetune = 'BatchSizeFinder' is not allowed" in outcome.err


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", [*HARMLESS_CALLBACKS, "RichProgressBar", "TQDMProgressBar"])
def test_a_harmless_callback_changes_nothing(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    given = {**HARMLESS_CALLBACKS, **BARS}[name]()
    logs = {"logger": pl.loggers.CSVLogger(tmp_path), "log_every_n_steps": 1, "enable_checkpointing": True}
    found = trained(pretraining(), ReconstructionError(), given, **logs)
    torch.testing.assert_close(found.state_dict(), trained(pretraining()).state_dict(), rtol=0, atol=0)


@pytest.mark.parametrize("name", AT_WORK)
def test_a_callback_at_work_leaves_weights_that_are_finite(name: str) -> None:
    found = trained(pretraining(), AT_WORK[name]())
    assert found.passes == [2, 2]
    assert all(bool(tensor.isfinite().all()) for tensor in found.state_dict().values())


def test_what_is_measured_needs_a_logger(memcomp_train: Run) -> None:
    for name in ("LearningRateMonitor", "DeviceStatsMonitor"):
        given = f"+callbacks.finetune.x._target_=lightning.pytorch.callbacks.{name}"
        outcome = memcomp_train(*SHORT, given, "hydra.run.dir=run")
        assert (outcome.status, Path("run").exists()) == (2, False)
        assert f"'{name}' is not allowed: expected a logger" in outcome.err


def test_a_bar_of_lightnings_takes_the_place_of_ours(memcomp_train: Run) -> None:
    bar = [
        f"+callbacks.{stage}.bar._target_=lightning.pytorch.callbacks.TQDMProgressBar"
        for stage in ("pretrain", "finetune")
    ]
    outcome = memcomp_train(*SHORT, *bar, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    both = [*bar, "+callbacks.finetune.more._target_=lightning.pytorch.callbacks.RichProgressBar"]
    outcome = memcomp_train(*SHORT, *both, "hydra.run.dir=other")
    assert (outcome.status, Path("other").exists()) == (2, False)
    assert "multiple progress bar callbacks" in outcome.err


@pytest.mark.parametrize(
    "settings",
    [
        {"limit_train_batches": 2},
        {"limit_train_batches": 0.5},
        {"overfit_batches": 1},
        {"precision": "bf16-mixed"},
    ],
    ids=str,
)
def test_a_plain_trainer_is_refused_the_same(settings: dict[str, Any]) -> None:
    (name,) = settings
    with pytest.raises(SettingError, match=rf"^trainer\.{name} = "):
        trained(pretraining(), data=bars(chunk_size=2), **settings)


class StopsIn(pl.Callback):
    """Asks to stop in the middle of a pass."""

    def __init__(self, at: int) -> None:
        self.at = at

    def on_train_batch_end(self, trainer: pl.Trainer, *_: Any) -> None:
        if trainer.fit_loop.epoch_loop.total_batch_idx == self.at:
            trainer.should_stop = True


class Times(torch.optim.SGD):
    """Counts its steps."""

    n_steps = 0

    def step(self, *arguments: Any, **settings: Any) -> Any:
        Times.n_steps += 1
        return super().step(*arguments, **settings)


def test_a_wish_to_stop_is_heard_at_the_end_of_the_pass() -> None:
    """In chunks of an update, and with several updates a pass: nine images."""
    for chunk_size, batch_size, steps_a_pass in ((2, None, 1), (9, 2, 5)):
        Times.n_steps = 0
        data = bars(chunk_size=chunk_size, batch_size=batch_size)
        network = Linear(9, 9)
        module = Classifier(network, iterations=20, optimizer=partial(Times, lr=0.1))
        trained(module, StopsIn(7), data=data)
        assert module.passes == [2]
        assert Times.n_steps == 2 * steps_a_pass


def stopping(**settings: Any) -> callbacks.EarlyStopping:
    return callbacks.EarlyStopping("pretrain/layer1/reconstruction_error", min_delta=9.0, **settings)


def test_a_layer_that_is_stopped_early_gives_way_to_the_next() -> None:
    """The criterion starts afresh; the layers are those of a run that was asked for as many passes."""
    module = trained(pretraining(20), ReconstructionError(), stopping(patience=3))
    assert module.passes == [4, 4]
    assert [tuple(gap.shape) for gap in module.energy_gaps] == [(), ()]
    expected = trained(pretraining(4))
    torch.testing.assert_close(module.state_dict(), expected.state_dict(), rtol=0, atol=0)


def test_a_layer_has_its_least_passes_and_the_last_its_own_number() -> None:
    assert trained(pretraining(20), ReconstructionError(), stopping(patience=3), min_epochs=6).passes == [6, 6]
    assert trained(pretraining(5), StopsIn(1)).passes == [2, 5]


@pytest.mark.filterwarnings("ignore:Be aware that when using `ckpt_path`")
@pytest.mark.parametrize("at", [1, 3, 4, 7, 8])
def test_a_stage_with_a_stopped_layer_goes_on_bit_for_bit(tmp_path: Path, at: int) -> None:
    keep = callbacks.ModelCheckpoint(
        tmp_path, "{epoch}", save_top_k=-1, every_n_epochs=1, save_on_train_epoch_end=True
    )
    whole = trained(pretraining(6), ReconstructionError(), stopping(patience=3), keep, enable_checkpointing=True)
    rest = pretraining(6)
    trainer = pl.Trainer(
        max_epochs=rest.n_epochs,
        logger=False,
        accelerator="cpu",
        callbacks=[ReconstructionError(), stopping(patience=3)],
        enable_progress_bar=False,
        enable_checkpointing=False,
        enable_model_summary=False,
    )
    trainer.fit(rest, datamodule=bars(), ckpt_path=tmp_path / f"epoch={at - 1}.ckpt", weights_only=True)
    assert rest.passes == whole.passes == [4, 4]
    torch.testing.assert_close(rest.state_dict(), whole.state_dict(), rtol=0, atol=0)


def test_the_table_and_the_record_say_after_how_many_passes(memcomp_train: Run) -> None:
    criterion = "_target_: lightning.pytorch.callbacks.EarlyStopping, min_delta: 9, patience: 2, monitor"
    outcome = memcomp_train(
        "sampler=cd",
        *WHOLE,
        "pretrain.iterations=9",
        "finetune.iterations=9",
        "logger=none",
        f"+callbacks.pretrain.stop={{{criterion}: pretrain/layer1/reconstruction_error}}",
        f"+callbacks.finetune.stop={{{criterion}: finetune/loss}}",
        "hydra.run.dir=run",
    )
    assert outcome.status == 0, outcome.err
    assert outcome.out.count("3 of 9") == 3
    stages = json.loads(Path("run/result.json").read_text())["stages"]
    assert {name: record["passes"] for name, record in stages.items()} == {"pretrain": [3, 3], "finetune": [3]}


def test_a_criterion_of_something_that_is_not_logged_is_named_in_a_line(memcomp_train: Run) -> None:
    criterion = "{_target_: lightning.pytorch.callbacks.EarlyStopping, monitor: val_loss}"
    outcome = memcomp_train(*SHORT, f"+callbacks.finetune.stop={criterion}", "hydra.run.dir=run")
    assert outcome.status == 2
    assert "callbacks.finetune: Early stopping conditioned on metric `val_loss`" in outcome.err
    assert "Traceback" not in outcome.err


def test_a_stage_without_a_step_is_an_error(memcomp_train: Run) -> None:
    outcome = memcomp_train(*SHORT, "+trainer.max_time=00:00:00:00", "hydra.run.dir=run")
    assert outcome.status == 2
    assert "the stage ended without an optimiser step" in outcome.err
    assert not Path("run/weights").exists()
    with pytest.raises(NotTrainedError, match="without an optimiser step"):
        trained(pretraining(), max_time={"seconds": 0})


def test_a_pass_that_leaves_an_update_half_done_is_an_error() -> None:
    class AllButOne:
        def __init__(self, batches: Any) -> None:
            self.batches = list(batches)[:-1]

        def __len__(self) -> int:
            return len(self.batches)

        def __iter__(self) -> Iterator[Any]:
            return iter(self.batches)

    class Partial(ImageDataModule):
        def train_dataloader(self) -> Any:
            return AllButOne(super().train_dataloader())

    data = Partial(ShiftingBars().load(), batch_size=None, chunk_size=2)
    with pytest.raises(NotTrainedError, match="in the middle of an update"):
        trained(EnergyPretraining(Greedy(DBN(9, [5])), CD(), iterations=2), data=data)


def test_a_short_try_is_no_stage(memcomp_train: Run) -> None:
    outcome = memcomp_train(*SHORT, "trainer.fast_dev_run=true", "data.chunk_size=500", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert not Path("run/weights").exists()
    assert not Path("run/result.json").exists()
