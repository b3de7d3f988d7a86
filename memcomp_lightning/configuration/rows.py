"""The rows of a run: read once, and dealt to its stages."""

import logging
import re
from collections.abc import Hashable
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.configuration.networks import shape_of
from memcomp_lightning.configuration.trainers import processes_of
from memcomp_lightning.data import ImageData, ImageDataModule, RowsDataModule, TableDataModule
from memcomp_lightning.data.schema import Schema
from memcomp_lightning.errors import UserError, require, require_parts
from memcomp_lightning.files import meant_by, stamp
from memcomp_lightning.models.units import Units

if TYPE_CHECKING:
    from memcomp_lightning.data import SequenceData, TableData

    Data: TypeAlias = ImageData | TableData | SequenceData

log = logging.getLogger(__name__)

HELD_OUT = 0.1
"""Share of the training rows that is held out where none is typed and something is to be chosen."""

FEWEST_TO_HOLD_OUT = 200
"""Training rows below which none are held out so."""

DEALT = ("partitions", "first_partitions", "validation_fraction", "chunk_size")
"""Settings of ``data`` that say how rows are dealt to replicas, held-out rows and chunks."""


def rows_of_stage(config: DictConfig, stage: str, data: "Data", units: Units) -> RowsDataModule:
    """Batches of a stage: what learns labels takes the rows that have one, fine-tuning as many as it is told."""
    settings = {name: config.data[name] for name in DEALT}
    if settings["validation_fraction"] is None:
        alone = isinstance(data, ImageData) or data.validation is not None
        # Of all processes, where they share the rows.
        few = not isinstance(data, ImageData) and getattr(data, "n_train", data.train.n) < FEWEST_TO_HOLD_OUT
        settings["validation_fraction"] = 0.0 if alone or few or not config.pretrain.keep_best else HELD_OUT
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
    data = loaded(config, schema)
    return rows_of_stage(config, "pretrain", data, shape_of(data, config).units)


def loaded(config: DictConfig, schema: Schema | None = None, *, shared: bool = False) -> "Data":
    """The data of a run; what is not images has a schema of its own, or takes that of an earlier run.

    Args:
        config: Of the run.
        schema: That of the earlier run.
        shared: Whether several processes that train together each hold a share of what can be shared.
    """
    source = instantiate(config.data.source)
    require_parts("data.source", source, "source of data", ("load",))
    if schema is not None and schema.as_json()["data"] == "table" and hasattr(source, "schema"):
        source = replace(source, schema=schema)
    if shared and getattr(source, "in_parts", False) and (which := processes_of(config))[1] > 1:
        if source.labelled or config.data.partitions != 1:
            log.warning("Each process holds all rows: labelled rows and data.partitions are not shared.")
        else:
            source = replace(source, share=which)
    data = _load_once(source, _files_of(config.data.source)) if isinstance(source, Hashable) else source.load()
    is_data, kind = isinstance(data, ImageData) or hasattr(data, "schema"), type(data).__name__
    require(is_data, "data.source", kind, "a load() that returns an ImageData, or data with a schema")
    return cast("Data", data)


@lru_cache(maxsize=1)
def _load_once(source: Any, files: tuple[object, ...]) -> Any:
    """Load a frozen source once for all jobs of a sweep, while its files stay as they are."""
    return source.load()


def _files_of(source: DictConfig) -> tuple[object, ...]:
    """The states of the files that the settings of a source name."""
    values = [value for value in source.values() if isinstance(value, str)]
    return tuple(stamp(path) for value in values for path in meant_by(value))


def settings_of_source(config: DictConfig) -> list[str]:
    """Names in the group ``data`` that the settings of its source refer to."""
    source = OmegaConf.to_container(config.data.source, resolve=False)
    assert isinstance(source, dict)
    return [found[1] for value in source.values() if (found := re.fullmatch(r"\$\{data\.(\w+)\}", str(value)))]
