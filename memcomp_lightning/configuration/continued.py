"""What a run goes on from: the weights, the schema and the chains of a finished one (``continue=FOLDER``)."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from torch import nn

from memcomp_lightning.configuration.composition import study_of
from memcomp_lightning.data.schema import Schema, schema_of
from memcomp_lightning.errors import UserError, require
from memcomp_lightning.modules.weights import load_weights, read_checkpoint
from memcomp_lightning.runs.addresses import read_at
from memcomp_lightning.runs.folder import RunFolder

_INITIAL = ("weights", "weight_init", "output_init")
"""Settings of a model that say nothing of what it is."""


@dataclass(frozen=True)
class Earlier:
    """A finished run that another one goes on from.

    Attributes:
        folder: Of the run.
        settings: Of the run.
        weights: The stage whose weights are taken: "pretrain", or "finetune" where there is no more pretraining.
    """

    folder: RunFolder
    settings: DictConfig
    weights: str

    @property
    def schema(self) -> Schema | None:
        """What the units stand for; None of a run that has kept nothing of it."""
        content = self.folder.schema
        return None if content is None else schema_of(content)

    def chains(self) -> dict[str, Any] | None:
        """What pretraining left beside its weights; an empty file of it where the run kept nothing."""
        if not self.folder.chains.is_file():
            return {"seed": None, "streams": {}, "models": {}}
        return read_checkpoint(self.folder.chains)

    def give(self, network: nn.Module) -> None:
        """Give a network the weights."""
        load_weights(network, self.folder.weights(self.weights))

    def check_data(self, schema: Schema | None) -> None:
        """Raise a UserError where data stand for other units than those of the run."""
        there, now = self.schema, schema
        if there is None or (now is not None and now.as_json() == there.as_json()):
            return
        theirs, ours = set(there.site_names), set() if now is None else set(now.site_names)
        gone, new = sorted(theirs - ours), sorted(ours - theirs)
        found = [f"{what} {_some(names)}" for what, names in (("lack", gone), ("have besides", new)) if names]
        differ = " and ".join(found) or "stand for other values"
        raise UserError(
            f"continue={self.folder.path}: the data {differ}, other than those of that run, whose weights are for "
            "its own. Use its data, or new rows with the same columns; for other data begin a new run."
        )


def earlier_of(config: DictConfig) -> Earlier | None:
    """The run that ``continue`` names, None without.

    Raises:
        UserError, SettingError: It has not finished, lacks the weights, or is of another network.
    """
    if config.get("continue") is None:
        return None
    with read_at(str(config["continue"])) as path:
        folder = finished(path)
    settings = folder.settings
    assert settings is not None
    require(config.model.weights is None, "model.weights", config.model.weights, "null with continue=FOLDER")
    allowed = "null with continue=FOLDER: what is chosen trains new networks"
    require(config.choose is None, "choose", config.choose, allowed)
    tuned = folder.weights("finetune").is_file() and config.finetune.iterations > 0
    weights = "finetune" if config.pretrain.iterations == 0 and tuned else "pretrain"
    if not folder.weights(weights).is_file():
        raise UserError(
            f"continue={folder.path}: that run pretrained nothing: more pretraining has no weights to go on "
            "from. Type pretrain.iterations=0 to go on with its fine-tuning."
        )
    there, now = (dict(_identity(of, with_units=weights == "finetune")) for of in (settings, config))
    for name in [*now, *(name for name in there if name not in now)]:
        same = there.get(name) == now.get(name)
        remedy = "For another network begin a new run, without continue=FOLDER."
        allowed = f"{there.get(name)!r}, as in {folder.path}, whose weights are gone on from"
        require(same, name, now.get(name), allowed, remedy)
    return Earlier(folder, settings, weights)


def finished(path: Path) -> RunFolder:
    """The folder of a finished run.

    Raises:
        UserError: It is none; the message says what to type.
    """
    folder = RunFolder(path)
    config = folder.settings
    if folder.overrides is None or config is None:
        raise UserError(f"continue={path}: there is no overrides.json. Name the folder of a run of memcomp-train.")
    if study_of(config) is not None:
        raise UserError(
            f"continue={path}: this is a figure or a comparison of many runs. Name the folder of one run."
        )
    if folder.result is None:
        raise UserError(f"continue={path}: that run has not finished. Finish it: memcomp-train resume={path}")
    if folder.schema is None:
        raise UserError(
            f"continue={path}: that run is of version {folder.version}, whose settings this one does not read. "
            f"Begin a run with its weights: model.weights={folder.weights('pretrain')}"
        )
    return folder


def _identity(config: DictConfig, *, with_units: bool) -> Iterator[tuple[str, Any]]:
    """What makes a network the same as another: its kind, its sizes, its units, its replicas."""
    for group in ("model", "units"):
        content = cast(dict[str, Any], OmegaConf.to_container(config[group], resolve=True))
        yield from ((f"{group}.{key!s}", value) for key, value in content.items() if key not in _INITIAL)
    # With another split, rows that were trained on would become test rows.
    for name in (
        *("partitions", "first_partitions", "columns"),
        *("test_fraction", "split_seed", "validation_fraction"),
    ):
        if name in config.data:
            value = config.data[name]
            yield f"data.{name}", OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
    if with_units:
        yield "finetune.units", config.finetune.units


def _some(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
