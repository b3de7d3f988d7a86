"""A run as objects: its network, and the stages that train it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import lightning.pytorch as pl
from torch import nn

from memcomp_lightning import rng
from memcomp_lightning.callbacks import BestWeights
from memcomp_lightning.data import ImageDataModule, RowsDataModule
from memcomp_lightning.errors import require
from memcomp_lightning.models import DBN, Randomiser
from memcomp_lightning.models.units import Bernoulli
from memcomp_lightning.modules import Classifier, EnergyPretraining, StageModule, UpDown
from memcomp_lightning.studies.records import Named
from memcomp_lightning.training import Batches, Pass, PretrainingStage, finetune, pretrain
from memcomp_lightning.training.filling import Filling
from memcomp_lightning.types import Batch


@dataclass(frozen=True)
class Stage:
    """One fit: what is trained, its images, and what looks at it under a trainer."""

    module: StageModule
    data: RowsDataModule
    callbacks: list[pl.Callback]

    @property
    def judge(self) -> BestWeights | None:
        """What chooses the pass to end with; None if it is the last one."""
        return next((callback for callback in self.callbacks if isinstance(callback, BestWeights)), None)


def passes_without_trainer(
    module: EnergyPretraining,
    batches: Batches,
    *,
    stage: PretrainingStage | None = None,
    iterations: int | None = None,
    seed: int = 0,
) -> Iterator[Pass]:
    """Train as a module would under a trainer; yield what is done, pass by pass.

    ``stage`` (of another network) and ``iterations`` stand in the place of the module's own.
    """
    return pretrain(
        stage or module.pretraining,
        batches,
        module.sampler,
        iterations=module.iterations if iterations is None else iterations,
        optimizer=module.make_optimizer,
        schedules=module.schedules,
        centring=module.centring,
        penalties=module.penalties,
        seed=seed,
    )


def finetuning_without_trainer(
    stage: Stage,
    network: nn.Module,
    batches: Batches,
    *,
    iterations: int,
    seeds: Sequence[int],
    held_out: Batch | None = None,
) -> Iterator[int]:
    """Train a network as the module of a stage would under a trainer; yield the passes that are done.

    Args:
        stage: Of fine-tuning.
        network: What is trained: the module's own, or several like it side by side.
        batches: Its images.
        iterations: Passes.
        seeds: Of the networks side by side.
        held_out: What the pass to end with is judged by, if the stage keeps the best; None keeps the newest.
    """
    module = stage.module
    assert isinstance(module, Classifier)
    judge = stage.judge
    return finetune(
        network,
        batches,
        iterations=iterations,
        optimizer=module.make_optimizer,
        schedules=module.schedules,
        loss=module.loss,
        dropout=module.dropout,
        seeds=seeds,
        keep_best_by=None if judge is None else held_out,
        best_by="accuracy" if judge is None else judge.by,
        patience=None if judge is None else judge.patience,
    )


@dataclass(frozen=True)
class Plan:
    """All that a run needs.

    Attributes:
        network: What is trained; the stages share it.
        pretraining: The first stage, None for a network without pretraining.
        finetuning: The last stage, None if left out.
        between: Changes the network after its pretraining, None if nothing does.
        stage_for: The way of pretraining for another network of the same kind; None without pretraining.
        updown: The training of a copy of the pretrained network as a generative model, None if left out.
    """

    network: nn.Module
    pretraining: Stage | None
    finetuning: Stage | None
    between: Randomiser | None = None
    stage_for: Callable[[Any], PretrainingStage] | None = None
    updown: Stage | None = None

    def fill_gaps(self, seed: int) -> None:
        """Let the pretrained model, as it is now, draw what is missing of the inputs of fine-tuning."""
        if self.finetuning is None or self.stage_for is None or not self.finetuning.data.has_gaps:
            return
        _, module = finetuning_of(self)
        module.fill_by(Filling(self.stage_for(self.network).phases[0].model, seed=seed))

    def unfold(self) -> None:
        """Let the generative model begin with the network's weights, as they are now."""
        if self.updown is not None and isinstance(self.network, DBN):
            cast(UpDown, self.updown.module).network.take(self.network)

    def change_between_stages(self, seed: int) -> None:
        """Apply ``between`` to a pretrained DBN before it is fine-tuned; the same seed does the same."""
        if self.between is not None and isinstance(self.network, DBN):
            self.between(self.network, generator=rng.stream(seed, "between stages"))

    @property
    def described(self) -> str:
        """The columns of the data as they are taken, for people; nothing of pictures."""
        return self.stages[0].data.described

    @property
    def stages(self) -> list[Stage]:
        """The stages in order."""
        return [stage for stage in (self.pretraining, self.updown, self.finetuning) if stage is not None]


@dataclass(frozen=True, kw_only=True)
class Trial(Named):
    """A training that leaves a record.

    Attributes:
        settings: Of its run, as plain values.
        build: Makes the objects of a run from its settings; a function of a module, which processes can import.
    """

    settings: dict[str, Any]
    build: Callable[[dict[str, Any]], Plan]


def pretraining_of(plan: Plan) -> tuple[Stage, EnergyPretraining]:
    """The first stage of a plan that pretrains, and its module."""
    stage = plan.pretraining
    assert stage is not None
    assert isinstance(stage.module, EnergyPretraining)
    return stage, stage.module


def require_bits(data: RowsDataModule, place: str) -> None:
    """Refuse rows that a study of bits cannot take.

    Args:
        data: Its rows.
        place: What the study has in the place of replicas.

    Raises:
        SettingError: They have replicas, missing values or units of another kind.
    """
    require(data.replicas == (), "data.partitions", data.replicas, f"1: {place} take their place")
    require(not data.has_gaps, "missing values", f"in {data.data_name}", "none")
    units = type(data.units).__name__
    require(isinstance(data.units, Bernoulli), "units", units, "Bernoulli, which are 0 or 1")


def images_of(stage: Stage) -> ImageDataModule:
    """The images of a stage.

    Raises:
        SettingError: They are no images.
    """
    data = stage.data
    allowed = "images: comparisons by likelihood take data=digits, mnist and the like"
    require(isinstance(data, ImageDataModule), "data", data.data_name, allowed)
    return cast(ImageDataModule, data)


def finetuning_of(plan: Plan) -> tuple[Stage, Classifier]:
    """The last stage of a plan that fine-tunes, and its module."""
    stage = plan.finetuning
    assert stage is not None
    assert isinstance(stage.module, Classifier)
    return stage, stage.module
