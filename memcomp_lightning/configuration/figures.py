"""A figure of the paper: its curves as trials, a record for each as soon as it exists."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from hydra import compose
from omegaconf import DictConfig

from memcomp_lightning.configuration.choice import for_trial, trial_of, tried_values
from memcomp_lightning.configuration.composition import check_not_given, composed_for
from memcomp_lightning.configuration.plans import build, check_without_trainer
from memcomp_lightning.configuration.values import filled
from memcomp_lightning.errors import require
from memcomp_lightning.files import write_text
from memcomp_lightning.studies import AccuracyTrial, Claim, FigurePlan, Records, grouped, runner

_SET_BY_FIGURE = {
    "pretrain.iterations": "It has figure.iterations.",
    "finetune.iterations": "It has figure.passes.",
    "seed": "It has figure.seeds.",
}
_SET_BY_CURVES = (
    "In it each curve has its own. +figure.curves.mine={label: mine, overrides: ['OVERRIDE']} adds it."
)


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Networks that differ only in what the figure varies.

    Attributes:
        label: For people.
        overrides: What is theirs, as on the command line.
        iterations: Of pretraining, unless those of the figure.
    """

    label: str
    overrides: list[str]
    iterations: list[int] | None = None


@dataclass(frozen=True, kw_only=True)
class Figure:
    """The settings of ``conf/figure``, which explains them."""

    name: str
    title: str
    against: str
    iterations: list[int]
    controls_at: list[int]
    passes: list[int]
    seeds: list[int]
    claims: list[Claim]
    curves: dict[str, Curve]
    networks: int | None = None
    workers: int | None = None
    choice: str | None = None

    def __post_init__(self) -> None:
        for name in ("passes", "iterations", "seeds"):
            _require_some(f"figure.{name}", getattr(self, name))
        for name, curve in self.curves.items():
            _require_some(f"figure.curves.{name}.iterations", curve.iterations)


def _require_some(name: str, values: list[int] | None) -> None:
    require(values is None or len(values) > 0, name, values, "a list of numbers, at least one: [1, 5]")


def train(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Train what is missing for a figure; each record is written when it exists."""
    # Composed before anything trains: a file edited meanwhile changes nothing.
    figure, composed = _figure(config), _curves(config, overrides)
    records = Records(folder)
    write_text(folder / "figure.json", json.dumps(asdict(_plan(config, overrides)), indent=1) + "\n")
    with runner(figure.name, workers=figure.workers, accelerator=config.trainer.accelerator) as run:
        for choosing in (True, False):
            trials = [
                trial
                for name, settings in composed.items()
                for trial in _trials(figure, name, settings, records, choosing=choosing)
            ]
            run(grouped(trials, tuple(sorted(figure.passes)), networks=figure.networks), records)


def check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Build the networks of every curve, and train nothing.

    Raises:
        UserError, SettingError, InstantiationException: As ``build``.
    """
    check_not_given(overrides, {**_SET_BY_FIGURE, "sampler": _SET_BY_CURVES}, "a figure")
    _plan(config, overrides)
    for name, settings in _curves(config, overrides).items():
        values = tried_values(settings)
        if values:
            allowed = "a setting that the figure does not set itself, for each network of a curve"
            chosen = settings.choose.setting
            require(chosen not in _SET_BY_FIGURE, f"choose.setting of figure.curves.{name}", chosen, allowed)
        for own in [for_trial(settings, value) for value in values] or [settings]:
            check_without_trainer(build(own), own)


def parts(config: DictConfig, overrides: Sequence[str]) -> dict[str, tuple[DictConfig, list[str]]]:
    """The figures of a run by their folders, each with its configuration and overrides."""
    if "all" not in config.figure:
        return {".": (config, list(overrides))}
    others = [o for o in overrides if o.lstrip("+").partition("=")[0] not in ("experiment", "figure.all")]
    own = {name: [f"experiment={name}", *others] for name in config.figure.all}
    return {name: (compose("config", some), some) for name, some in own.items()}


def _figure(config: DictConfig) -> Figure:
    return filled(Figure, config.figure, "figure")


def _curves(config: DictConfig, overrides: Sequence[str]) -> dict[str, DictConfig]:
    """Settings of each curve."""
    return {name: composed_for(overrides, curve.overrides) for name, curve in _figure(config).curves.items()}


def _plan(config: DictConfig, overrides: Sequence[str]) -> FigurePlan:
    """What the report needs to know of the settings."""
    figure, composed = _figure(config), _curves(config, overrides)
    data = build(composed_for((*overrides, "pretrain.iterations=1", "finetune.iterations=1"))).stages[0].data
    claimed = [name for claim in figure.claims for name in claim.curves if name in figure.curves]
    n_parts = math.prod(data.replicas)
    parts = f"{n_parts} of {config.data.partitions} partitions of {data.n_train:,} images" if data.replicas else ""
    seeds = f"{len(figure.seeds)} seeds" if len(figure.seeds) > 1 else ""
    whole = f"all {data.n_train:,} training images" if not parts else ""
    return FigurePlan(
        name=figure.name,
        title=figure.title,
        data=data.images.name,
        against=figure.against,
        passes=sorted(figure.passes),
        claims=figure.claims,
        labels={name: figure.curves[name].label for name in dict.fromkeys((*claimed, *figure.curves))},
        chosen={name: own.choose.setting for name, own in composed.items() if tried_values(own)},
        stop_early=[name for name, own in composed.items() if own.finetune.keep_best],
        scale=", ".join(part for part in (whole, parts, seeds) if part),
    )


def _trials(
    figure: Figure, name: str, composed: DictConfig, records: Records, *, choosing: bool
) -> Iterator[AccuracyTrial]:
    """The networks of a curve, or those for its choice, that have no record."""
    iterations, seeds = figure.curves[name].iterations or figure.iterations, figure.seeds
    tried: Sequence[Any] = tried_values(composed)
    if choosing:
        values, iterations, seeds = tried, iterations[-1:], seeds[:1]
    else:
        values = [records.best_value(name)] if tried else [None]
    done = records.keys
    for value in values:
        first = trial_of(composed, name, value=value, choosing=choosing)
        trials = (replace(first, iterations=n, seed=seed) for n in iterations for seed in seeds)
        yield from (trial for trial in trials if trial.key not in done)
