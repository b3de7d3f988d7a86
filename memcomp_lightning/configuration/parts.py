"""Parts of a stage: what samples, steps, changes the steps, and looks on."""

import copy
import logging
import math
import re
from typing import Any, cast

import lightning.pytorch as pl
import torch
from lightning.pytorch.callbacks import ProgressBar
from omegaconf import DictConfig
from torch import nn

from memcomp_lightning.callbacks import BestLikelihood, BestWeights, LogLikelihood, Schedules, StageProgressBar
from memcomp_lightning.configuration.errors import in_words
from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.configuration.values import require_held_out
from memcomp_lightning.data import RowsDataModule
from memcomp_lightning.errors import UserError, require, require_choice, require_count, require_parts
from memcomp_lightning.modules.trainers import check_callback
from memcomp_lightning.samplers import InBfloat16, ModeAssisted
from memcomp_lightning.samplers.bfloat16 import PRODUCTS
from memcomp_lightning.training import OptimizerFactory, Penalty, Schedule
from memcomp_lightning.training.schedules import check_schedules

log = logging.getLogger(__name__)

FEWEST_PASSES = 10
"""Of pretraining whose length is given in updates."""


def part_of(settings: object, name: str) -> Any:
    """What settings with a ``_target_`` stand for; None for null."""
    named = settings is None or (isinstance(settings, DictConfig) and "_target_" in settings)
    require(named, name, settings, "null, or settings by name with a _target_")
    return instantiate(settings)


def schedules_of(config: DictConfig, stage: str, iterations: int) -> list[Schedule]:
    """What changes the optimiser of a stage from pass to pass; n_passes null is all of them."""
    found = []
    for name, settings in (config[stage].schedules or {}).items():
        if isinstance(settings, DictConfig) and settings.get("n_passes", 0) is None:
            settings = copy.deepcopy(settings)
            settings.n_passes = max(iterations, 1)
        schedule = part_of(settings, f"{stage}.schedules.{name}")
        if schedule is not None:
            require_parts(f"{stage}.schedules.{name}", schedule, "schedule", ("check", "begin_pass"))
            found.append(schedule)
    return found


def optimizer_of(config: DictConfig, stage: str, schedules: list[Schedule]) -> OptimizerFactory:
    """The optimiser's factory, tried on one parameter so that bad settings show before training."""
    factory: OptimizerFactory = instantiate(config[stage].optimizer)
    try:
        optimizer = factory([nn.Parameter(torch.zeros(1))])
        check_schedules(schedules, [optimizer])
    except (TypeError, ValueError) as error:
        unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
        remedy = f" Leave it out: '~{stage}.optimizer.{unknown[1]}'." if unknown else ""
        raise UserError(f"{stage}.optimizer: {in_words(error)}{remedy}") from error
    return factory


def callbacks_of(config: DictConfig, stage: str) -> list[pl.Callback]:
    """What looks on; what would change training is refused."""
    settings = (config.callbacks[stage] or {}).values()
    callbacks = [instantiate(callback) for callback in settings if callback is not None]
    for callback in callbacks:
        kind = type(callback).__name__
        require(isinstance(callback, pl.Callback), f"callbacks.{stage}", kind, "callbacks of Lightning")
        check_callback(callback, f"callbacks.{stage}")
        allowed = "callbacks that look at training: what changes it belongs to the stage"
        remedy = "Use finetune.keep_best=true." if isinstance(callback, BestWeights) else f"Use {stage}.schedules."
        looks = not isinstance(callback, BestWeights | Schedules)
        require(looks, f"callbacks.{stage}", kind, allowed, remedy)
    if any(isinstance(callback, ProgressBar) and type(callback) is not StageProgressBar for callback in callbacks):
        # A trainer has one bar: the one that somebody chose takes the place of ours.
        callbacks = [callback for callback in callbacks if type(callback) is not StageProgressBar]
    return callbacks


def penalties_of(config: DictConfig) -> list[Penalty]:
    """What the couplings cost in pretraining."""
    found = []
    for name, settings in (config.pretrain.get("penalties") or {}).items():
        penalty = part_of(settings, f"pretrain.penalties.{name}")
        if penalty is not None:
            allowed = "a penalty, which is called with a model: memcomp_lightning.training.L1, L2, GroupSparsity"
            require(callable(penalty), f"pretrain.penalties.{name}", type(penalty).__name__, allowed)
            found.append(penalty)
    return found


def passes_of(config: DictConfig, rows: RowsDataModule) -> int:
    """Passes of pretraining: as many as are typed, or as make up the updates, ten at least."""
    iterations, updates = config.pretrain.iterations, config.pretrain.updates
    if iterations is not None or updates is None:
        require_count("pretrain.iterations", iterations, minimum=0)
        return int(iterations)
    require_count("pretrain.updates", updates)
    return max(FEWEST_PASSES, round(int(updates) / _updates_a_pass(config, rows)))


def _updates_a_pass(config: DictConfig, rows: RowsDataModule) -> int:
    size = cast("int | None", config.pretrain.batch_size)
    return math.ceil(rows.n_train / min(size or rows.n_train, rows.n_train))


def with_best_likelihood(
    config: DictConfig, rows: RowsDataModule, callbacks: list[pl.Callback]
) -> list[pl.Callback]:
    """The callbacks; where the best weights are kept, with one that does in the place of ``LogLikelihood``."""
    keeps, patience = config.pretrain.keep_best, config.pretrain.patience
    if patience is not None:
        require_count("pretrain.patience", patience)
        remedy = "It waits for better weights, so that they are kept: pretrain.keep_best=true."
        require(keeps, "pretrain.patience", patience, "null where pretrain.keep_best is false", remedy)
        if not rows.holds_out:
            require_held_out(config, "where pretrain.patience is set", "pass")
    if not keeps:
        return callbacks
    if not rows.holds_out:
        log.info("No rows are held out to choose the best weights of pretraining by: its last ones stay.")
        return callbacks
    own = (config.callbacks.pretrain or {}).get("log_likelihood") or {}
    settings = {str(name): value for name, value in own.items() if name != "_target_"}
    best = BestLikelihood(**settings, patience=patience)
    return [*(callback for callback in callbacks if not isinstance(callback, LogLikelihood)), best]


def sampler_of(config: DictConfig, data: RowsDataModule, iterations: int) -> Any:
    """The sampler; the schedule of mode assistance spans all updates of a layer unless it says otherwise."""
    settings = copy.deepcopy(config.sampler)
    schedule, size = settings.get("schedule"), min(config.pretrain.batch_size or data.n_train, data.n_train)
    if schedule is not None and schedule.get("n_updates") is None:
        schedule.n_updates = iterations * _updates_a_pass(config, data)
    sampler = instantiate(settings)
    if isinstance(sampler, ModeAssisted):
        chunk = config.data.chunk_size
        remedy = "Each chunk would toss the coin for itself: raise data.chunk_size or lower pretrain.batch_size."
        require(chunk >= size, "data.chunk_size", chunk, f"at least the {size} images of an update", remedy)
    products = config.pretrain.products
    require_choice("pretrain.products", products, PRODUCTS)
    return InBfloat16(sampler=sampler) if products == "bf16" else sampler
