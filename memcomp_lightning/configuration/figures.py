"""A figure of the paper: its curves as trials, a record for each as soon as it exists."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from hydra import compose
from omegaconf import DictConfig

from memcomp_lightning.configuration.choice import for_trial, trial_of, tried_values
from memcomp_lightning.configuration.composition import check_not_given, composed_for
from memcomp_lightning.configuration.plans import build, check_without_trainer
from memcomp_lightning.configuration.values import filled
from memcomp_lightning.errors import require, require_some
from memcomp_lightning.files import write_json
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
    """Networks that differ only in what the figure varies; ``iterations`` stand in the place of the figure's."""

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
    workers: int | str | None = None
    choice: str | None = None

    def __post_init__(self) -> None:
        numbers = "a list of numbers, at least one: [1, 5]"
        for name in ("passes", "iterations", "seeds"):
            require_some(f"figure.{name}", getattr(self, name), numbers)
        for name, curve in self.curves.items():
            require_some(f"figure.curves.{name}.iterations", curve.iterations, numbers)


def train(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Train what is missing for a figure; each record is written when it exists."""
    # Composed before anything trains: a file edited meanwhile changes nothing.
    figure, composed, plan = _read(config, overrides)
    records = Records(folder)
    write_json(folder / "figure.json", asdict(plan))
    with runner(figure.name, workers=figure.workers, accelerator=config.trainer.accelerator) as run:
        for choosing in (True, False):
            trials = list(_trials(figure, composed, records, choosing=choosing))
            run(grouped(trials, tuple(plan.passes), networks=figure.networks), records)


def check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Build the networks of every curve, and train nothing; raises as ``build``."""
    check_not_given(overrides, {**_SET_BY_FIGURE, "sampler": _SET_BY_CURVES}, "a figure")
    _, composed, _ = _read(config, overrides)
    for name, settings in composed.items():
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
    for name in config.figure.all:
        require(re.fullmatch(r"\w+", str(name)) is not None, "figure.all", name, "names of figures")
    own = {name: [f"experiment={name}", *others] for name in config.figure.all}
    return {name: (compose("config", some), some) for name, some in own.items()}


def _read(config: DictConfig, overrides: Sequence[str]) -> tuple[Figure, dict[str, DictConfig], FigurePlan]:
    """The settings of a figure, those of each curve, and what the report needs to know of them."""
    figure = filled(Figure, config.figure, "figure")
    composed = {name: composed_for(overrides, curve.overrides) for name, curve in figure.curves.items()}
    data = build(composed_for((*overrides, "pretrain.iterations=1", "finetune.iterations=1"))).stages[0].data
    claimed = [name for claim in figure.claims for name in claim.curves if name in figure.curves]
    scale = [f"all {data.n_train:,} training images"]
    if data.replicas:
        n_parts = math.prod(data.replicas)
        scale = [f"{n_parts} of {config.data.partitions} partitions of {data.n_train:,} images"]
    if len(figure.seeds) > 1:
        scale.append(f"{len(figure.seeds)} seeds")
    plan = FigurePlan(
        name=figure.name,
        title=figure.title,
        data=data.data_name,
        against=figure.against,
        passes=sorted(figure.passes),
        claims=figure.claims,
        labels={name: figure.curves[name].label for name in dict.fromkeys((*claimed, *figure.curves))},
        chosen={name: own.choose.setting for name, own in composed.items() if tried_values(own)},
        stop_early=[name for name, own in composed.items() if own.finetune.keep_best],
        scale=", ".join(scale),
    )
    return figure, composed, plan


def _trials(
    figure: Figure, composed: Mapping[str, DictConfig], records: Records, *, choosing: bool
) -> Iterator[AccuracyTrial]:
    """The networks of all curves, or those for their choices, that have no record."""
    done = records.keys
    for name, settings in composed.items():
        iterations, seeds = figure.curves[name].iterations or figure.iterations, figure.seeds
        values: Sequence[float | None] = tried_values(settings)
        if choosing:
            iterations, seeds = iterations[-1:], seeds[:1]
        else:
            values = [records.best_value(name)]  # None where nothing is chosen
        for value in values:
            first = trial_of(settings, name, value=value, choosing=choosing)
            trials = (replace(first, iterations=n, seed=seed) for n in iterations for seed in seeds)
            yield from (trial for trial in trials if trial.key not in done)
