"""The trainer of each stage: what the stage sets itself, what is the user's to set, and what is refused."""

import difflib
import inspect
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import ProgressBar
from lightning.pytorch.loggers import Logger
from lightning.pytorch.loggers.logger import DummyLogger
from lightning.pytorch.strategies.launchers import _MultiProcessingLauncher
from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.configuration.errors import explain
from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.errors import UserError, require, require_count
from memcomp_lightning.modules.trainers import NOT_WITH_STAGES, check_trainer, tries
from memcomp_lightning.modules.weights import AtomicCheckpointIO, LastCheckpoint
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.studies.plan import Plan, Stage

_BY_THE_STAGE = "nothing, each stage sets it"
_PASSES = "Use pretrain.iterations and finetune.iterations."
_SUMMARY = "Add ModelSummary of lightning.pytorch.callbacks to callbacks.pretrain or callbacks.finetune."
_NOT_HERE: dict[str, tuple[tuple[object, ...], str, str]] = {
    "max_epochs": ((), _BY_THE_STAGE, _PASSES),
    "max_steps": ((-1,), _BY_THE_STAGE, _PASSES),
    "min_steps": ((None,), _BY_THE_STAGE, "Use trainer.min_epochs, passes of a stage or layer."),
    "callbacks": ((), _BY_THE_STAGE, "Use callbacks.pretrain and callbacks.finetune."),
    "logger": ((), _BY_THE_STAGE, "Use the group logger, as in logger=csv."),
    "default_root_dir": ((), _BY_THE_STAGE, "Use hydra.run.dir."),
    "enable_model_summary": ((), _BY_THE_STAGE, _SUMMARY),
    "num_sanity_val_steps": ((), _BY_THE_STAGE, ""),
    "use_distributed_sampler": ((), _BY_THE_STAGE, "The data are dealt to the processes already."),
    "plugins": ((), _BY_THE_STAGE, "Use trainer.precision and trainer.strategy."),
    "enable_checkpointing": (
        (None, True),
        "true: checkpoints are what resume= goes on from",
        "Use checkpoint_every for fewer of them.",
    ),
    "limit_val_batches": (
        (None, 0, 1.0),
        "0 for no validation, or 1.0 for all held-out images",
        "Use data.validation_fraction.",
    ),
    "limit_test_batches": ((None, 1.0), "1.0, all test images", ""),
    "limit_predict_batches": ((None, 1.0), "1.0: nothing is predicted while training", ""),
    "barebones": ((False,), "false: a run keeps checkpoints and logs", "Use callbacks=minimal and logger=none."),
    "sync_batchnorm": (
        (False,),
        "false: each process normalises by its own images",
        "Use one device for statistics of whole batches.",
    ),
    "model_registry": ((None,), "null: weights stay in the run folder", ""),
    **{name: ((None, neutral), allowed, hint) for name, (neutral, allowed, hint) in NOT_WITH_STAGES.items()},
}
"""Arguments of the trainer that are not the user's to set: values that change nothing, what to say."""


def check_trainers(plan: Plan, config: DictConfig) -> None:
    """Make the trainer of each stage; refuse settings and callbacks that cannot be used, alone or together."""
    folder = RunFolder(Path())
    loggers: list[Logger] = [DummyLogger() for logger in config.logger.values() if logger is not None]
    for stage in plan.stages:
        try:
            trainer = trainer_of(stage, config, folder, loggers)
            check_trainer(trainer)
            of_its_own = isinstance(trainer.strategy.launcher, _MultiProcessingLauncher)
            allowed = "one that starts its processes by the command, not by fork or spawn"
            strategy = config.trainer.strategy
            require(not of_its_own, "trainer.strategy", strategy, allowed, "Use trainer.strategy=ddp.")
        except (MisconfigurationException, RuntimeError) as error:
            raise UserError(f"trainer, {stage.module.stage}: {explain(error)}") from error
        n_batches = len(stage.data.train_batches(trainer.global_rank, trainer.world_size))
        every, passes = trainer.val_check_interval, trainer.check_val_every_n_epoch
        within = isinstance(every, float) or passes is None or every is None or every <= n_batches
        allowed = f"at most the {n_batches} batches of a pass of {stage.module.stage}"
        remedy = "Use trainer.check_val_every_n_epoch, or null for it to count batches over passes."
        require(within or trainer.limit_val_batches == 0, "trainer.val_check_interval", every, allowed, remedy)
        judge = stage.judge
        share, allowed = trainer.limit_val_batches, "1.0 where finetune.keep_best is true, or patience is set"
        require(judge is None or share == 1.0 or tries(trainer), "trainer.limit_val_batches", share, allowed)
        waits = judge is not None and judge.patience is not None and not tries(trainer)
        allowed = "once a pass where finetune.patience, which counts passes, is set: 1.0 and 1"
        once = every is None or (isinstance(every, float) and every == 1)
        for name, value, each in (
            ("val_check_interval", every, once),
            ("check_val_every_n_epoch", passes, passes == 1),
        ):
            require(each or not waits, f"trainer.{name}", value, allowed)


def processes_of(config: DictConfig) -> tuple[int, int]:
    """Number of this process, and how many train together, by the settings of the trainer."""
    try:
        settings = {**_settings(config.trainer), "max_epochs": 1, "logger": False, "enable_checkpointing": False}
        trainer: pl.Trainer = instantiate(settings, _convert_="all")
    except (MisconfigurationException, RuntimeError) as error:
        raise UserError(f"trainer: {explain(error)}") from error
    return trainer.global_rank, trainer.world_size


def trainer_of(stage: Stage, config: DictConfig, folder: RunFolder, loggers: list[Logger]) -> pl.Trainer:
    """The Trainer of one stage; what the stage needs is set here, the rest, which is checked, in its group."""
    path = folder.checkpoint(stage.module.stage)
    settings = _settings(config.trainer)
    bars = [type(callback).__name__ for callback in stage.callbacks if isinstance(callback, ProgressBar)]
    shows = settings.get("enable_progress_bar")
    allowed = f"true where there is a {'/'.join(bars)} among the callbacks"
    remedy = "Leave it out: callbacks.pretrain.progress=null callbacks.finetune.progress=null."
    require(not bars or shows in (None, True), "trainer.enable_progress_bar", shows, allowed, remedy)
    if settings.get("profiler") in ("simple", "advanced"):
        # Lightning's own report of these goes to a log that is not shown.
        kind = f"lightning.pytorch.profilers.{settings['profiler'].capitalize()}Profiler"
        settings["profiler"] = {"_target_": kind, "dirpath": str(path.parent), "filename": "profile"}
    keep_last = LastCheckpoint(
        dirpath=path.parent,
        filename=path.stem,
        every_n_epochs=config.checkpoint_every,
        save_on_train_epoch_end=True,
        enable_version_counter=False,
    )
    make = instantiate(settings, _partial_=True, _convert_="all")
    trainer: pl.Trainer = make(
        max_epochs=stage.module.n_epochs,
        callbacks=[*stage.callbacks, keep_last],
        logger=loggers or False,
        use_distributed_sampler=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        default_root_dir=path.parent,
        plugins=[AtomicCheckpointIO()],
    )
    return trainer


def _settings(config: DictConfig) -> dict[str, Any]:
    """The settings of the trainer, those that are the user's to set."""
    resolved: Any = OmegaConf.to_container(config, resolve=True)
    settings = {str(name): value for name, value in resolved.items()}
    of_trainer = [*inspect.signature(pl.Trainer).parameters, "_target_"]
    known = of_trainer if settings.get("_target_") == "lightning.pytorch.Trainer" else list(settings)
    for name, value in settings.items():
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f" Did you mean trainer.{close[0]}?" if close else ""
            raise UserError(
                f"setting trainer.{name} does not exist.{hint} Known here: {', '.join(sorted(known))}."
            )
        harmless, allowed, remedy = _NOT_HERE.get(name, ((value,), "", ""))
        require(any(_same(value, one) for one in harmless), f"trainer.{name}", value, allowed, remedy)
    for name, minimum in (("check_val_every_n_epoch", 1), ("min_epochs", 0)):
        if settings.get(name) is not None:
            require_count(f"trainer.{name}", settings[name], minimum)
    return settings


def _same(value: object, harmless: object) -> bool:
    """Whether two values of a setting are the same one; 1 batch is not 1.0, all of them."""
    return value == harmless and (type(value) is type(harmless) or value == 0)
