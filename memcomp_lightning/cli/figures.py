"""A figure of the paper: its curves as networks to train, a record for each as soon as it exists."""

import functools
import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra import compose
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, ListConfig, OmegaConf

from memcomp_lightning.cli.build import build, check_without_trainer, plan_of
from memcomp_lightning.cli.choice import for_trial, tried_values, with_choice
from memcomp_lightning.cli.overrides import check_entry, check_not_given, search_paths
from memcomp_lightning.errors import require
from memcomp_lightning.files import write_text
from memcomp_lightning.studies import FigurePlan, Records
from memcomp_lightning.studies.accuracy import Member, grouped, run_unit
from memcomp_lightning.studies.runner import run_all, runner

_SET_BY_FIGURE = {
    "pretrain.iterations": "It has figure.iterations.",
    "finetune.iterations": "It has figure.passes.",
    "seed": "It has figure.seeds.",
}
_SET_BY_CURVES = (
    "In it each curve has its own. +figure.curves.mine={label: mine, overrides: ['OVERRIDE']} adds it."
)
CURVE_SETTINGS = ("label", "overrides", "iterations")


def train_curves(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Train what is missing for a figure; each record is written when it exists."""
    records = Records(folder)
    write_text(folder / "figure.json", json.dumps(_shown(config, overrides), indent=1) + "\n")
    composed = _curves(config, overrides)
    with runner(config.figure.workers, config.trainer.accelerator, run_unit) as run:
        for choosing in (True, False):
            members = [
                member
                for name, settings in composed.items()
                for member in _members(config, name, settings, records, choosing=choosing)
            ]
            units = grouped(members, tuple(sorted(config.figure.passes)), networks=config.figure.networks)
            if units:
                run_all(run, units, records, config.figure.name)


def _curves(config: DictConfig, overrides: Sequence[str]) -> dict[str, DictConfig]:
    """Settings of each curve, composed before anything trains: a file edited meanwhile changes nothing."""
    curves = config.figure.curves.items()
    return {str(name): composed_for(tuple(overrides), tuple(curve.overrides)) for name, curve in curves}


def parts(config: DictConfig, overrides: Sequence[str]) -> dict[str, tuple[DictConfig, list[str]]]:
    """The figures of a run by their folders, each with its configuration and overrides."""
    if "all" not in config.figure:
        return {".": (config, list(overrides))}
    others = [o for o in overrides if o.lstrip("+").partition("=")[0] not in ("experiment", "figure.all")]
    own = {name: [f"experiment={name}", *others] for name in config.figure.all}
    return {name: (compose("config", some), some) for name, some in own.items()}


def _shown(config: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    """What the report needs to know of the settings: ``studies.FigurePlan``."""
    figure = OmegaConf.to_container(config.figure, resolve=True)
    assert isinstance(figure, dict)
    curves, composed = figure["curves"], _curves(config, overrides)
    data = build(composed_for((*overrides, "pretrain.iterations=1", "finetune.iterations=1"))).stages[0].data
    claimed = [name for claim in figure["claims"] for name in (claim["than"], claim["better"]) if name in curves]
    n_parts = math.prod(data.replicas)
    parts = f"{n_parts} of {config.data.partitions} partitions of {data.n_train:,} images" if data.replicas else ""
    seeds = f"{len(figure['seeds'])} seeds" if len(figure["seeds"]) > 1 else ""
    whole = f"all {data.n_train:,} training images" if not parts else ""
    return {
        "name": figure["name"],
        "title": figure["title"],
        "data": data.images.name,
        "against": figure["against"],
        "passes": sorted(figure["passes"]),
        "claims": figure["claims"],
        "labels": {name: curves[name]["label"] for name in dict.fromkeys((*claimed, *curves))},
        "chosen": {name: own.choose.setting for name, own in composed.items() if tried_values(own)},
        "stop_early": [name for name, own in composed.items() if own.finetune.keep_best],
        "scale": ", ".join(part for part in (whole, parts, seeds) if part),
    }


def check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Build the networks of every curve, and train nothing.

    Raises:
        UserError, SettingError, InstantiationException: As ``build``.
    """
    check_not_given(overrides, {**_SET_BY_FIGURE, "sampler": _SET_BY_CURVES}, "a figure")
    for name in ("passes", "iterations", "seeds"):
        _require_list(f"figure.{name}", config.figure[name])
    for name, curve in config.figure.curves.items():
        check_entry(f"figure.curves.{name}", curve, CURVE_SETTINGS)
        _require_list(f"figure.curves.{name}.iterations", curve.get("iterations", [1]))
    FigurePlan.of(_shown(config, overrides))
    for name, settings in _curves(config, overrides).items():
        values = tried_values(settings)
        if values:
            allowed = "a setting that the figure does not set itself, for each network of a curve"
            chosen = settings.choose.setting
            require(chosen not in _SET_BY_FIGURE, f"choose.setting of figure.curves.{name}", chosen, allowed)
        for own in [for_trial(settings, value) for value in values] or [settings]:
            check_without_trainer(build(own), own)


def _require_list(name: str, values: Any) -> None:
    fits = isinstance(values, ListConfig | list) and len(values) > 0
    require(fits, name, values, "a list of numbers, at least one: [1, 5]")


def _members(
    config: DictConfig, name: str, composed: DictConfig, records: Records, *, choosing: bool
) -> Iterator[Member]:
    """The networks of a curve, or those for its choice, that have no record."""
    curve = config.figure.curves[name]
    iterations, seeds = list(curve.get("iterations", config.figure.iterations)), list(config.figure.seeds)
    values: list[float | None] = [None]
    if tried := tried_values(composed):
        values = [*tried] if choosing else [records.best_choice(name)]
    elif choosing:
        return
    for value in values:
        if choosing:
            iterations, seeds = iterations[-1:], seeds[:1]
        missing = [(n, s) for n in iterations for s in seeds if not records.has(name, value, choosing, n, s)]
        if missing:
            settings = composed
            if value is not None:
                settings = for_trial(composed, value) if choosing else with_choice(composed, value)
            plain: Any = OmegaConf.to_container(settings, resolve=False)
            yield from (Member(name, plain, plan_of, n, seed, value, choosing) for n, seed in missing)


def composed_for(common: tuple[str, ...], own: tuple[str, ...] = ()) -> DictConfig:
    """The configuration of one curve, without the figure; composed once, and not to be changed.

    Args:
        common: Overrides of all curves. Those that a curve has no setting for are left out: ``solver.max_steps``
            where its solver is descent.
        own: The curve's overrides, which must apply.
    """
    return _composed(
        tuple(search_paths(common)), tuple(o for o in common if not o.lstrip("+~").startswith(_OF_MANY_RUNS)), own
    )


@functools.cache
def _composed(search_path: tuple[str, ...], common: tuple[str, ...], own: tuple[str, ...]) -> DictConfig:
    try:
        composed = compose("config", [*search_path, *common, *own])
    except ConfigCompositionException:
        groups = (o for o in (*common, *own) if "." not in o.partition("=")[0])
        bare = compose("config", [*search_path, *groups])
        applying = (o for o in common if _applies(o.partition("=")[0], bare))
        composed = compose("config", [*search_path, *applying, *own])
    composed.figure = composed.worth = None
    return composed


_OF_MANY_RUNS = ("hydra.", "figure.", "figure/", "worth.", "worth/")
"""Overrides that say nothing of a single run."""


def _applies(name: str, config: DictConfig) -> bool:
    if "." not in name or name.startswith("+"):
        return True
    parent, _, key = name.rpartition(".")
    node = OmegaConf.select(config, parent)
    return isinstance(node, DictConfig) and key in node
