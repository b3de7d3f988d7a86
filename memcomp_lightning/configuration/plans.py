"""From a configuration to the objects of a run; everything that can be refused is refused here."""

import copy
import inspect
import logging
import math
import re
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from functools import lru_cache, partial
from operator import methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, cast

import lightning.pytorch as pl
import torch
from hydra.utils import get_class, get_method
from lightning.pytorch.callbacks import ProgressBar
from omegaconf import DictConfig, ListConfig, OmegaConf
from torch import nn

from memcomp_lightning import rng
from memcomp_lightning.callbacks import (
    BestLikelihood,
    BestWeights,
    LogLikelihood,
    Schedules,
    StageProgressBar,
    StillFalling,
)
from memcomp_lightning.configuration.composition import STUDIES
from memcomp_lightning.configuration.continued import earlier_of
from memcomp_lightning.configuration.errors import in_words
from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.configuration.values import check_values, require_held_out
from memcomp_lightning.data import ImageData, ImageDataModule, PixelLayout, RowsDataModule, TableDataModule
from memcomp_lightning.data.schema import ImageSchema, Schema
from memcomp_lightning.errors import UserError, require, require_choice, require_count, require_parts
from memcomp_lightning.models import DBN, GenerativeDBN, energy_models, start_at_means
from memcomp_lightning.models.units import Units
from memcomp_lightning.modules import Classifier, DBNClassifier, EnergyPretraining, UpDown
from memcomp_lightning.modules.trainers import PRECISIONS, check_bare_loop, check_callback, precision_of
from memcomp_lightning.modules.weights import load_weights
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import ModeAssisted
from memcomp_lightning.samplers.base import require_state
from memcomp_lightning.studies.plan import Plan, Stage
from memcomp_lightning.training import EnergyStep, OptimizerFactory, Penalty, Schedule, UpDownStep, balanced
from memcomp_lightning.training.schedules import check_schedules
from memcomp_lightning.training.score import FILL_IN, NO_GAPS

if TYPE_CHECKING:
    from memcomp_lightning.data import SequenceData, TableData

    Data: TypeAlias = ImageData | TableData | SequenceData

log = logging.getLogger(__name__)

_STAGE_SETTINGS = ("iterations", "batch_size", "optimizer", "schedules")
_OF_MODELS = ("data", "units", "model", "solver", "sampler", "positive")
_OF_TRAINING = (
    "pretrain",
    "updown",
    "finetune",
    "trainer",
    "logger",
    "callbacks",
    "seed",
    "checkpoint_every",
    "continue",
)
_DEALT = ("partitions", "first_partitions", "validation_fraction", "chunk_size")
_STOPPING = ("keep_best", "best_by", "patience")
_SETTINGS = {
    "": (*_OF_MODELS, *_OF_TRAINING, "between_stages", "choose", "tried", *STUDIES),
    "data": ("source", *_DEALT),
    "pretrain": (
        *_STAGE_SETTINGS,
        "updates",
        "initial_bias",
        "centring",
        "penalties",
        "stage",
        "keep_best",
        "patience",
    ),
    "finetune": (*_STAGE_SETTINGS, "loss", "units", "labels", "class_weights", "dropout", *_STOPPING),
    "updown": (*_STAGE_SETTINGS, "labels", "visible", "sampler"),
    "callbacks": ("pretrain", "updown", "finetune"),
}
"""What is read here, by group, so that ``+group.name=value`` cannot add what nobody reads."""


HELD_OUT = 0.1
"""Share of a table's training rows that is held out where none is typed."""

FEWEST_TO_HOLD_OUT = 200
"""Training rows below which none are held out so."""

FEWEST_PASSES = 10
"""Of pretraining whose length is given in updates."""


def build(config: DictConfig) -> Plan:
    """Build the objects of a run.

    Raises:
        UserError, SettingError, InstantiationException: A setting does not exist, has the wrong type or is
            out of range; data or weights cannot be read.
    """
    for group, known in _SETTINGS.items():
        own = _of_source(config) if group == "data" else ()
        for name in config if group == "" else config[group]:
            require_choice(f"setting {group}".rstrip(), name, (*known, *own))
    check_values(config)
    seed = config.seed
    precision_of(config.trainer.precision)
    require_count("checkpoint_every", config.checkpoint_every)
    for name, values in config.tried.items():
        numbers = isinstance(values, ListConfig) and all(isinstance(x, int | float) for x in values)
        require(numbers, f"tried.{name}", values, "a list of numbers")
    earlier = earlier_of(config)
    data = _loaded(config, None if earlier is None else earlier.schema)
    if earlier is not None:
        earlier.check_data(ImageSchema.of(data) if isinstance(data, ImageData) else data.schema)
    shape = shape_of(data, config)
    units = shape.units
    network = network_of(config, shape)
    if earlier is not None and earlier.weights == "pretrain":
        earlier.give(network)
    require_count("finetune.iterations", config.finetune.iterations, minimum=0)
    pretraining = finetuning = stage_for = None
    models = energy_models(network)
    if models and config.pretrain.iterations != 0:
        callbacks, rows = _callbacks(config, "pretrain"), _data(config, "pretrain", data, units)
        iterations = _passes(config, rows)
        if config.pretrain.keep_best:
            callbacks = _with_best_likelihood(config, rows, callbacks)
        centring = _part(config.pretrain.centring, "pretrain.centring")
        allowed = "null, or {_target_: memcomp_lightning.objective.Centring, rate: ...}"
        require(centring is None or isinstance(centring, Centring), "pretrain.centring", centring, allowed)
        initial_bias = config.pretrain.initial_bias
        require_choice("pretrain.initial_bias", initial_bias, ("data", "zero"))
        if initial_bias == "data" and config.model.weights is None and earlier is None:
            some = rows.some_train()
            start_at_means(models[0], some.v, some.observed, some.weight)
        schedules = _schedules(config, "pretrain", iterations)
        stage_for = instantiate(config.pretrain.stage)
        try:
            stage = stage_for(network)
        except TypeError as error:
            raise UserError(f"pretrain.stage: {error}") from error
        module = EnergyPretraining(
            stage,
            _sampler(config, rows, iterations),
            iterations=iterations,
            optimizer=_optimizer(config, "pretrain", schedules),
            schedules=schedules,
            centring=centring,
            penalties=_penalties(config),
            seed=seed,
            earlier=None if earlier is None else earlier.chains(),
        )
        pretraining = Stage(module, rows, callbacks)
    updown = _updown(config, network, data, units)
    labels = config.finetune.labels
    require(labels is None or data.n_classes > 0, "finetune.labels", labels, "null for data without labels")
    if config.finetune.iterations > 0 and data.n_classes:
        layered = isinstance(network, DBN) or not models
        allowed = "0 for a Boltzmann machine, which is no feed-forward network"
        remedy = "For a deep one that is fine-tuned use model=dbn pretrain=joint."
        require(layered, "finetune.iterations", config.finetune.iterations, allowed, remedy)
        rows = _data(config, "finetune", data, units)
        draws = pretraining is not None and isinstance(network, DBN)
        require(draws or not rows.has_gaps, "missing values", "in the data of a classifier", NO_GAPS, FILL_IN)
        callbacks = [*_callbacks(config, "finetune"), *_judges(config, rows)]
        if labels is not None:
            callbacks.append(StillFalling())
        classifier = classifier_of(config, network, data.n_classes, class_weights=_class_weights(config, rows))
        if earlier is not None and earlier.weights == "finetune":
            earlier.give(classifier.network)
        finetuning = Stage(classifier, rows, callbacks)
    between = _part(config.between_stages, "between_stages") if isinstance(network, DBN) else None
    plan = Plan(network, pretraining, finetuning, between, stage_for, updown)
    allowed = "an integer >= 1 where there is no pretraining"
    require(bool(plan.stages), "finetune.iterations", config.finetune.iterations, allowed)
    return plan


def _updown(config: DictConfig, network: nn.Module, data: "Data", units: Units) -> Stage | None:
    """The training of a DBN as a generative model; None where it is left out."""
    settings = config.updown
    require_count("updown.iterations", settings.iterations, minimum=0)
    if settings.iterations == 0:
        return None
    require(isinstance(network, DBN), "updown.iterations", settings.iterations, "0 for what is no DBN")
    labels, classes = settings.labels, data.n_classes
    require(isinstance(labels, bool), "updown.labels", labels, "true or false")
    require(classes > 0 or not labels, "updown.labels", labels, "false for data without labels")
    rows = _data(config, "updown", data, units)
    require(not rows.has_gaps, "missing values", "in the data of up-down training", "none", FILL_IN)
    step = UpDownStep(top=EnergyStep(sampler=instantiate(settings.sampler)), visible=settings.visible)
    schedules = _schedules(config, "updown", settings.iterations)
    module = UpDown(
        GenerativeDBN(cast(DBN, network), n_classes=classes if labels else 0),
        step=step,
        iterations=settings.iterations,
        optimizer=_optimizer(config, "updown", schedules),
        schedules=schedules,
        seed=config.seed,
    )
    require_state(step.top.sampler.init(module.network.top, 1, generator=rng.stream(config.seed, "check")))
    return Stage(module, rows, _callbacks(config, "updown"))


def classifier_of(
    config: DictConfig, network: nn.Module, n_classes: int, *, class_weights: torch.Tensor | None = None
) -> Classifier:
    """The fine-tuning of a network."""
    schedules = _schedules(config, "finetune", config.finetune.iterations)
    make: Callable[..., Classifier] = partial(Classifier, network)
    if isinstance(network, DBN):
        make = partial(
            DBNClassifier,
            network,
            n_classes=n_classes,
            units=config.finetune.units,
            output_init=instantiate(config.model.get("output_init")),
            generator=rng.stream(config.seed, "output weights"),
        )
    return make(
        iterations=config.finetune.iterations,
        optimizer=_optimizer(config, "finetune", schedules),
        schedules=schedules,
        loss=config.finetune.loss,
        class_weights=class_weights,
        dropout=config.finetune.get("dropout", 0.0),
        seed=config.seed,
    )


def _judges(config: DictConfig, rows: RowsDataModule) -> list[BestWeights]:
    """What chooses the pass that fine-tuning ends with; nothing where it is the last one."""
    keeps, patience = config.finetune.keep_best, config.finetune.patience
    judge = BestWeights(by=config.finetune.best_by, patience=patience)
    if not keeps and patience is None:
        return []
    if not rows.holds_out:
        which = "finetune.keep_best is true" if patience is None else "finetune.patience is set"
        require_held_out(config, f"where {which}", "pass")
    return [judge]


def _class_weights(config: DictConfig, rows: RowsDataModule) -> torch.Tensor | None:
    """How much each class counts in the loss; None is all alike."""
    given, n = config.finetune.class_weights, rows.n_classes
    if given is None:
        return None
    if given == "balanced":
        return balanced(rows.class_totals)
    numbers = isinstance(given, ListConfig) and all(type(weight) in (int, float) for weight in given)
    fits = numbers and len(given) == n and all(weight > 0 for weight in given)
    classes = ", ".join(rows.class_names[:10]) + (", ..." if n > 10 else "")
    plain = OmegaConf.to_container(given) if isinstance(given, ListConfig) else given
    allowed = f"null, balanced, or a list of {n} numbers > 0, one for each class: {classes}"
    require(fits, "finetune.class_weights", plain, allowed)
    return torch.tensor(list(given), dtype=torch.float32, device="cpu")


def plan_of(settings: Mapping[str, object]) -> Plan:
    """Build the objects of a run from its settings as plain values."""
    return build(OmegaConf.create(dict(settings)))


def check_without_trainer(plan: Plan, config: DictConfig) -> None:
    """Refuse callbacks and limits that change training: a loop without a trainer would leave them out."""
    allowed = "false: figures, comparisons and choices train without a trainer, to the end"
    require(not config.pretrain.keep_best, "pretrain.keep_best", config.pretrain.keep_best, allowed)
    for stage in plan.stages:
        for callback in stage.callbacks:
            check_bare_loop(callback, f"callbacks.{stage.module.stage}")
    allowed = "null: figures, comparisons and choices train new networks"
    require(config.get("continue") is None, "continue", config.get("continue"), allowed)
    gaps = plan.finetuning is not None and plan.finetuning.data.has_gaps
    allowed = "none where figures, comparisons and choices train classifiers"
    require(not gaps, "missing values", "in the data of a classifier", allowed, FILL_IN)
    max_time = config.trainer.get("max_time")
    allowed = "null: figures, comparisons and choices train without a trainer"
    require(max_time is None, "trainer.max_time", max_time, allowed)


def _part(settings: object, name: str) -> Any:
    """What settings with a ``_target_`` stand for; None for null."""
    named = settings is None or (isinstance(settings, DictConfig) and "_target_" in settings)
    require(named, name, settings, "null, or settings by name with a _target_")
    return instantiate(settings)


def _schedules(config: DictConfig, stage: str, iterations: int) -> list[Schedule]:
    """What changes the optimiser of a stage from pass to pass; n_passes null is all of them."""
    found = []
    for name, settings in (config[stage].schedules or {}).items():
        if isinstance(settings, DictConfig) and settings.get("n_passes", 0) is None:
            settings = copy.deepcopy(settings)
            settings.n_passes = max(iterations, 1)
        schedule = _part(settings, f"{stage}.schedules.{name}")
        if schedule is not None:
            require_parts(f"{stage}.schedules.{name}", schedule, "schedule", ("check", "begin_pass"))
            found.append(schedule)
    return found


def _units(settings: DictConfig, name: str, n_sites: int) -> Units:
    """A layer of the kind that settings name, with so many units."""
    require(isinstance(settings, DictConfig), name, settings, "settings by name with a _target_")
    try:
        units = instantiate(settings)(n_sites)
    except TypeError as error:
        raise UserError(f"{name}: {in_words(error)}") from error
    require(isinstance(units, Units), name, type(units).__name__, "a kind of memcomp_lightning.models.units")
    return cast(Units, units)


class Shape(NamedTuple):
    """What a network must fit: all that it needs to know of the data.

    Attributes:
        units: Visible units.
        n_classes: Number of classes, 0 without labels.
        layout: Where the units lie in a picture; None where they lie in none.
    """

    units: Units
    n_classes: int
    layout: PixelLayout | None


def shape_of(data: "Data", config: DictConfig) -> Shape:
    """What the network must fit: tables say themselves which units they need."""
    if isinstance(data, ImageData):
        allowed = "a kind of units; columns are those of data=table, data=arrays and data=sequences"
        require("_target_" in config.units, "units", "columns", allowed)
        return Shape(units_of_settings(config, data.layout.n_visible), data.n_classes, data.layout)
    remedy = "Name the kinds of columns by data.columns={NAME: KIND}."
    named = "_target_" not in config.units
    require(named, "units", config.units.get("_target_"), "units=columns, which follow from the data", remedy)
    return Shape(data.units(), data.n_classes, data.layout)


def units_of_settings(config: DictConfig, n_sites: int) -> Units:
    """Visible units of the kind that ``units`` names."""
    return _units(config.units, "units", n_sites)


def _of_source(config: DictConfig) -> list[str]:
    """Names in the group ``data`` that the settings of its source refer to."""
    source = OmegaConf.to_container(config.data.source, resolve=False)
    assert isinstance(source, dict)
    return [found[1] for value in source.values() if (found := re.fullmatch(r"\$\{data\.(\w+)\}", str(value)))]


def _penalties(config: DictConfig) -> list[Penalty]:
    """What the couplings cost in pretraining."""
    found = []
    for name, settings in (config.pretrain.get("penalties") or {}).items():
        penalty = _part(settings, f"pretrain.penalties.{name}")
        if penalty is not None:
            allowed = "a penalty, which is called with a model: memcomp_lightning.training.L1, L2, GroupSparsity"
            require(callable(penalty), f"pretrain.penalties.{name}", type(penalty).__name__, allowed)
            found.append(penalty)
    return found


def network_of(config: DictConfig, shape: Shape) -> nn.Module:
    """The network of a run, with drawn weights or those of ``model.weights``."""
    units, layout = shape.units, shape.layout
    settings = OmegaConf.to_container(config.model, resolve=True)
    assert isinstance(settings, dict)
    weights = settings.pop("weights", None)
    settings.pop("output_init", None)
    partitions, first = config.data.partitions, config.data.first_partitions
    require_count("data.partitions", partitions)
    parameters = inspect.signature(get_class(settings["_target_"])).parameters
    arguments: dict[str, Any] = {
        "replicas": (min(partitions, first or partitions),) if partitions > 1 else (),
        "generator": rng.stream(config.seed, "weights"),
        **({"visible": units} if "visible" in parameters else {"n_visible": units.n}),
    }
    connectivity = settings.get("connectivity")
    if isinstance(connectivity, dict) and "_target_" in connectivity:
        of_picture = (
            {} if layout is None else {"height": layout.height, "width": layout.width, "pixels": layout.pixels}
        )
        known = inspect.signature(get_method(connectivity["_target_"])).parameters
        own = {name: value for name, value in of_picture.items() if name in known}
        allowed = "null for data that are no pictures, or data.picture=[HEIGHT, WIDTH]"
        require(bool(own) or "height" not in known, "model.connectivity", connectivity["_target_"], allowed)
        settings["connectivity"] = {**connectivity, **(own or {"n_visible": units.n_sites})}
    if "hidden" in settings:
        require_count("model.n_hidden", settings["n_hidden"])
        arguments["hidden"] = _units(config.model.hidden, "model.hidden", settings.pop("n_hidden"))
        settings.pop("hidden")
    factory = instantiate(settings, _partial_=True, _convert_="all")
    if "n_classes" in parameters:
        arguments["n_classes"] = shape.n_classes
    try:
        network: nn.Module = factory(**arguments)
    except TypeError as error:
        raise UserError(f"model: {error}") from error
    network.to(PRECISIONS[precision_of(config.trainer.precision)])
    if weights is not None:
        require(isinstance(weights, str), "model.weights", weights, "the path of a weight file, or null")
        load_weights(network, Path(weights))
    return network


def _passes(config: DictConfig, rows: RowsDataModule) -> int:
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


def _with_best_likelihood(
    config: DictConfig, rows: RowsDataModule, callbacks: list[pl.Callback]
) -> list[pl.Callback]:
    """The callbacks with one that keeps the best weights in the place of the one that measures likelihoods."""
    if not rows.holds_out:
        log.info("No rows are held out to choose the best weights of pretraining by: its last ones stay.")
        return callbacks
    own = config.callbacks.pretrain.get("log_likelihood") or {}
    settings = {str(name): value for name, value in own.items() if name != "_target_"}
    best = BestLikelihood(**settings, patience=config.pretrain.patience)
    return [*(callback for callback in callbacks if not isinstance(callback, LogLikelihood)), best]


def _sampler(config: DictConfig, data: RowsDataModule, iterations: int) -> Any:
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
    return sampler


def _data(config: DictConfig, stage: str, data: "Data", units: Units) -> RowsDataModule:
    """Batches of a stage: what learns labels takes the rows that have one, fine-tuning as many as it is told."""
    settings = {name: config.data[name] for name in _DEALT}
    if settings["validation_fraction"] is None:
        alone = isinstance(data, ImageData) or data.validation is not None or data.train.n < FEWEST_TO_HOLD_OUT
        settings["validation_fraction"] = 0.0 if alone or not config.pretrain.keep_best else HELD_OUT
    settings |= {"batch_size": config[stage].batch_size, "seed": config.seed}
    if stage == "updown" and config.updown.labels:
        settings["labels"] = "all"
    if stage == "finetune":
        settings["labels"] = "all" if config.finetune.labels is None else config.finetune.labels
    try:
        if isinstance(data, ImageData):
            return ImageDataModule(data, units=units, **settings)
        return TableDataModule(data, **settings)
    except ValueError as error:
        raise UserError(f"{stage}, data: {error}") from error


def rows_of(config: DictConfig, schema: Schema | None = None) -> RowsDataModule:
    """The rows of a run's pretraining, read and dealt as its settings say; nothing else of the run is built.

    Args:
        config: Of the run.
        schema: That of the run, by which a table is read; None finds it anew.
    """
    data = _loaded(config, schema)
    return _data(config, "pretrain", data, shape_of(data, config).units)


def _optimizer(config: DictConfig, stage: str, schedules: list[Schedule]) -> OptimizerFactory:
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


def _callbacks(config: DictConfig, stage: str) -> list[pl.Callback]:
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


def _loaded(config: DictConfig, schema: Schema | None = None) -> "Data":
    """The data of a run; what is not images has a schema of its own, or takes that of an earlier run."""
    source = instantiate(config.data.source)
    require_parts("data.source", source, "source of data", ("load",))
    if schema is not None and schema.as_json()["data"] == "table" and hasattr(source, "schema"):
        source = replace(source, schema=schema)
    data = _load_once(source) if isinstance(source, Hashable) else source.load()
    is_data, kind = isinstance(data, ImageData) or hasattr(data, "schema"), type(data).__name__
    require(is_data, "data.source", kind, "a load() that returns an ImageData, or data with a schema")
    return cast("Data", data)


_load_once = lru_cache(maxsize=1)(methodcaller("load"))
"""For the jobs of a sweep; sources are frozen, hence hashable."""
