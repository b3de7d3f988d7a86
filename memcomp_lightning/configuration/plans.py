"""From a configuration to the objects of a run; everything that can be refused is refused here."""

import logging
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, cast

import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from torch import nn

from memcomp_lightning import rng
from memcomp_lightning.callbacks import (
    BestWeights,
    StillFalling,
)
from memcomp_lightning.configuration.composition import STUDIES, study_of
from memcomp_lightning.configuration.continued import earlier_of
from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.configuration.networks import network_of, shape_of
from memcomp_lightning.configuration.parts import (
    callbacks_of,
    optimizer_of,
    part_of,
    passes_of,
    penalties_of,
    sampler_of,
    schedules_of,
    with_best_likelihood,
)
from memcomp_lightning.configuration.rows import DEALT, loaded, rows_of_stage, settings_of_source
from memcomp_lightning.configuration.values import check_values, require_held_out
from memcomp_lightning.data import ImageData, RowsDataModule
from memcomp_lightning.data.schema import ImageSchema
from memcomp_lightning.errors import UserError, require, require_choice, require_count
from memcomp_lightning.models import DBN, GenerativeDBN, energy_models, start_at_means
from memcomp_lightning.models.units import Units
from memcomp_lightning.modules import Classifier, DBNClassifier, EnergyPretraining, UpDown
from memcomp_lightning.modules.trainers import check_bare_loop, precision_of
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers.base import require_state
from memcomp_lightning.studies.plan import Plan, Stage
from memcomp_lightning.training import EnergyStep, UpDownStep, balanced
from memcomp_lightning.training.score import FILL_IN, NO_GAPS

if TYPE_CHECKING:
    from memcomp_lightning.configuration.rows import Data

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
_STOPPING = ("keep_best", "best_by", "patience")
_SETTINGS = {
    "": (*_OF_MODELS, *_OF_TRAINING, "between_stages", "copy_to", "copy_every", "choose", "tried", *STUDIES),
    "data": ("source", *DEALT),
    "pretrain": (
        *_STAGE_SETTINGS,
        "updates",
        "initial_bias",
        "centring",
        "penalties",
        "products",
        "stage",
        "keep_best",
        "patience",
    ),
    "finetune": (*_STAGE_SETTINGS, "loss", "units", "labels", "class_weights", "dropout", *_STOPPING),
    "updown": (*_STAGE_SETTINGS, "labels", "visible", "sampler"),
    "callbacks": ("pretrain", "updown", "finetune"),
}
"""What is read here, by group, so that ``+group.name=value`` cannot add what nobody reads."""


def build(config: DictConfig) -> Plan:
    """Build the objects of a run.

    Raises:
        UserError, SettingError, InstantiationException: A setting does not exist, has the wrong type or is
            out of range; data or weights cannot be read.
    """
    for group, known in _SETTINGS.items():
        own = settings_of_source(config) if group == "data" else ()
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
    # Studies and choices train in one process, without a trainer.
    shared = study_of(config) is None and config.choose is None
    data = loaded(config, None if earlier is None else earlier.schema, shared=shared)
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
        rows = rows_of_stage(config, "pretrain", data, units)
        callbacks = with_best_likelihood(config, rows, callbacks_of(config, "pretrain"))
        iterations = passes_of(config, rows)
        centring = part_of(config.pretrain.centring, "pretrain.centring")
        allowed = "null, or {_target_: memcomp_lightning.objective.Centring, rate: ...}"
        require(centring is None or isinstance(centring, Centring), "pretrain.centring", centring, allowed)
        initial_bias = config.pretrain.initial_bias
        require_choice("pretrain.initial_bias", initial_bias, ("data", "zero"))
        if initial_bias == "data" and config.model.weights is None and earlier is None:
            some = rows.some_train()
            start_at_means(models[0], some.v, some.observed, some.weight)
        schedules = schedules_of(config, "pretrain", iterations)
        stage_for = instantiate(config.pretrain.stage)
        try:
            stage = stage_for(network)
        except TypeError as error:
            raise UserError(f"pretrain.stage: {error}") from error
        module = EnergyPretraining(
            stage,
            sampler_of(config, rows, iterations),
            iterations=iterations,
            optimizer=optimizer_of(config, "pretrain", schedules),
            schedules=schedules,
            centring=centring,
            penalties=penalties_of(config),
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
        rows = rows_of_stage(config, "finetune", data, units)
        draws = pretraining is not None and isinstance(network, DBN)
        require(draws or not rows.has_gaps, "missing values", "in the data of a classifier", NO_GAPS, FILL_IN)
        callbacks = [*callbacks_of(config, "finetune"), *_judges(config, rows)]
        if labels is not None:
            callbacks.append(StillFalling())
        classifier = classifier_of(config, network, data.n_classes, class_weights=_class_weights(config, rows))
        if earlier is not None and earlier.weights == "finetune":
            earlier.give(classifier.network)
        finetuning = Stage(classifier, rows, callbacks)
    between = part_of(config.between_stages, "between_stages") if isinstance(network, DBN) else None
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
    rows = rows_of_stage(config, "updown", data, units)
    require(not rows.has_gaps, "missing values", "in the data of up-down training", "none", FILL_IN)
    step = UpDownStep(top=EnergyStep(sampler=instantiate(settings.sampler)), visible=settings.visible)
    schedules = schedules_of(config, "updown", settings.iterations)
    module = UpDown(
        GenerativeDBN(cast(DBN, network), n_classes=classes if labels else 0),
        step=step,
        iterations=settings.iterations,
        optimizer=optimizer_of(config, "updown", schedules),
        schedules=schedules,
        seed=config.seed,
    )
    require_state(step.top.sampler.init(module.network.top, 1, generator=rng.stream(config.seed, "check")))
    return Stage(module, rows, callbacks_of(config, "updown"))


def classifier_of(
    config: DictConfig, network: nn.Module, n_classes: int, *, class_weights: torch.Tensor | None = None
) -> Classifier:
    """The fine-tuning of a network."""
    schedules = schedules_of(config, "finetune", config.finetune.iterations)
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
        optimizer=optimizer_of(config, "finetune", schedules),
        schedules=schedules,
        loss=config.finetune.loss,
        class_weights=class_weights,
        dropout=config.finetune.get("dropout", 0.0),
        seed=config.seed,
    )


def _judges(config: DictConfig, rows: RowsDataModule) -> list[BestWeights]:
    """What chooses the pass that fine-tuning ends with; nothing where it is the last one."""
    keeps, patience = config.finetune.keep_best, config.finetune.patience
    if patience is not None:
        require_count("finetune.patience", patience)
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
