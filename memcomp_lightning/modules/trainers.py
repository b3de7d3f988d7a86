"""Refuses, before anything trains, the settings and callbacks of a trainer that would break a stage."""

import lightning.pytorch as pl
import torch
from lightning.pytorch import callbacks
from lightning.pytorch.strategies import DeepSpeedStrategy, FSDPStrategy, ModelParallelStrategy

from memcomp_lightning.errors import require

PRECISIONS = {
    "32-true": torch.float32,
    "64-true": torch.float64,
    "16-true": torch.float16,
    "bf16-true": torch.bfloat16,
}
"""Each has one dtype for all that a stage computes."""

_SPELLINGS = {"32": "32-true", "64": "64-true", "None": "32-true"}

_WHOLE_PASSES = "The batches of a pass make whole updates together. Try fast_dev_run for a short look."
_OWN_STEPS = "nothing, the stages step their optimisers themselves"

NOT_WITH_STAGES: dict[str, tuple[object, str, str]] = {
    "limit_train_batches": (1.0, "1.0, every image once a pass", _WHOLE_PASSES),
    "overfit_batches": (0.0, "0.0, every image once a pass", _WHOLE_PASSES),
    "accumulate_grad_batches": (1, _OWN_STEPS, "Use batch_size."),
    "gradient_clip_val": (None, _OWN_STEPS, "Use batch_size."),
    "gradient_clip_algorithm": (None, _OWN_STEPS, "Use batch_size."),
}
"""Arguments of ``pl.Trainer`` that would change an update: the value that leaves it alone, and what to say."""

_CALLBACKS: dict[type, tuple[str, str]] = {
    callbacks.BackboneFinetuning: ("none: there is no backbone that could be frozen", "Use BaseFinetuning."),
    callbacks.BatchSizeFinder: ("none: it trains on batches of its own", "Use batch_size."),
    callbacks.GradientAccumulationScheduler: (f"none: {_OWN_STEPS.partition(', ')[2]}", "Use batch_size."),
    callbacks.LearningRateFinder: ("none: it trains on batches of its own", "Use choose or a sweep of the rate."),
    callbacks.ModelPruning: ("none: it replaces parameters, and energies do not see its masks", ""),
    callbacks.StochasticWeightAveraging: (
        "none: it adds a pass of its own to the stage",
        "Use WeightAveraging, or LearningRateDecay for the rate.",
    ),
}
_ONLY_LOOK = (
    callbacks.DeviceStatsMonitor,
    callbacks.LearningRateMonitor,
    callbacks.ModelCheckpoint,
    callbacks.ModelSummary,
    callbacks.ProgressBar,
    callbacks.ThroughputMonitor,
)
_NEED_A_LOGGER = (callbacks.DeviceStatsMonitor, callbacks.LearningRateMonitor, callbacks.ThroughputMonitor)


def precision_of(value: object) -> str:
    """The precision that a value of ``trainer.precision`` means: one of :data:`PRECISIONS`, or a SettingError.

    >>> precision_of(64)
    '64-true'
    """
    name = _SPELLINGS.get(str(value), str(value))
    short = name in ("16", "bf16")
    meaning = f"{name} is Lightning's short form of {name}-mixed: write {name}-true." if short else ""
    allowed = "32-true, 64-true, 16-true or bf16-true: one dtype for all that a stage computes"
    require(name in PRECISIONS, "trainer.precision", value, allowed, meaning)
    return name


def tries(trainer: pl.Trainer) -> bool:
    """Whether a trainer only tries a few batches (``fast_dev_run``): nothing that it does is kept."""
    return bool(getattr(trainer, "fast_dev_run", False))


def check_trainer(trainer: pl.Trainer) -> None:
    """Raise a SettingError if a setting or callback would change an update, leave images out, or fail late."""
    precision_of(trainer.precision)
    for name, (neutral, allowed, remedy) in NOT_WITH_STAGES.items():
        value = getattr(trainer, name)
        require(value == neutral or tries(trainer), f"trainer.{name}", value, allowed, remedy)
    in_parts = isinstance(trainer.strategy, DeepSpeedStrategy | FSDPStrategy | ModelParallelStrategy)
    name = type(trainer.strategy).__name__
    require(not in_parts, "trainer.strategy", name, "one that keeps parameters whole", "Use trainer.strategy=ddp.")
    for callback in getattr(trainer, "callbacks", ()):
        check_callback(callback)
        name = type(callback).__name__
        remedy = "Use logger=csv or logger=tensorboard, or leave the callback out."
        logs = bool(trainer.loggers) or not isinstance(callback, _NEED_A_LOGGER)
        require(logs, "callback", name, "a logger for what it measures", remedy)


def check_bare_loop(callback: pl.Callback, where: str) -> None:
    """Raise a SettingError unless a callback only looks, so that a loop without a trainer may leave it out."""
    module, name = type(callback).__module__, type(callback).__name__
    ours = module.startswith("memcomp_lightning.callbacks.")
    looks = isinstance(callback, _ONLY_LOOK) or not getattr(callback, "changes_training", not ours)
    allowed = "callbacks that only look at training: figures, comparisons and choices train without a trainer"
    remedy = "Leave it out, or say changes_training = False in its class if it only looks."
    require(looks, where, name, allowed, "Leave it out." if ours else remedy)


def check_callback(callback: pl.Callback, where: str = "callback") -> None:
    """Raise a SettingError unless a callback leaves the updates of a stage to the stage."""
    for kind, (allowed, remedy) in _CALLBACKS.items():
        require(not isinstance(callback, kind), where, type(callback).__name__, allowed, remedy)
