"""``experiment=sampler_worth``: RBMs trained by many samplers, measured by their likelihood along the way."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.cli.build import build, check_without_trainer, plan_of
from memcomp_lightning.cli.figures import composed_for
from memcomp_lightning.cli.overrides import check_entry, check_not_given
from memcomp_lightning.errors import UserError, require, require_choice, require_count
from memcomp_lightning.files import write_text
from memcomp_lightning.studies.likelihood import Job, model_of, module_of, run_job, side_by_side
from memcomp_lightning.studies.measures import MEASURES
from memcomp_lightning.studies.runner import run_all, runner
from memcomp_lightning.studies.worth import Courses

DATA_SETTINGS = ("label", "overrides", "passes", "measure", "methods", "rates", "replicas", "choosing", "points")
_SET_BY_COMPARISON = {"pretrain.iterations": "It has passes of its data sets.", "sampler": "It has methods."}
METHOD_SETTINGS = ("label", "overrides", "longer", "rates", "greedy_start")


def check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Build one replica of every method on every data set, and train nothing.

    Raises:
        UserError, SettingError, InstantiationException: As ``build``.
    """
    worth = config.worth
    if config.figure is not None:
        raise UserError(
            "preset=quick is one of figures: make the comparison smaller with worth.only=[DATA_SET], "
            "worth.replicas=N or worth.methods.NAME.rates=[...]."
        )
    for key in ("replicas", "choosing", "points", "gradient_draws"):
        require_count(f"worth.{key}", worth[key])
    require(len(worth.rates) > 0, "worth.rates", list(worth.rates), "at least one learning rate")
    check_not_given(overrides, _SET_BY_COMPARISON, "a comparison")
    require(worth.only is None or len(worth.only) > 0, "worth.only", [], "names of data sets, or null for all")
    for kind, known in (("data_sets", DATA_SETTINGS), ("methods", METHOD_SETTINGS)):
        for name, settings in worth[kind].items():
            check_entry(f"worth.{kind}.{name}", settings, known)
            longer = settings.get("longer", 1)
            require(longer > 0, f"worth.{kind}.{name}.longer", longer, "a number > 0")
            for key in ("methods", "rates"):
                found = settings.get(key, ["one"])
                require(len(found) > 0, f"worth.{kind}.{name}.{key}", list(found), "at least one, or leave it out")
    for name, data_set in worth.data_sets.items():
        require_choice(f"worth.data_sets.{name}.measure", data_set.measure, tuple(MEASURES))
        for method in data_set.get("methods", ()):
            require_choice(f"worth.data_sets.{name}.methods", method, tuple(worth.methods))
    for name in worth.only or ():
        require_choice("worth.only", name, tuple(worth.data_sets))
    for name in (*worth.claimed, *worth.baselines):
        require_choice("worth.claimed and worth.baselines", name, tuple(worth.methods))
    if worth.workers is not None:
        require_count("worth.workers", worth.workers)
    require_choice("trainer.accelerator", config.trainer.accelerator, ("auto", "cpu"))
    seen: set[tuple[str, str]] = set()
    for job in _jobs(config, overrides, Path(), done=set()):
        own = OmegaConf.create(job.settings)
        plan = build(own)
        check_without_trainer(plan, own)
        data, model = module_of(plan)[0].data, model_of(side_by_side([plan]))
        require(data.replicas == (), "data.partitions", data.replicas, "1: replicas are seeds here")
        if (job.data_set, job.method) not in seen:
            seen.add((job.data_set, job.method))
            measure = MEASURES[job.measure](data, 1)
            if job.measure != "ais":  # which refuses no model of two classes, and takes its time
                measure(model)


def train_worth(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Train what is missing; each course is written when it exists."""
    courses = Courses(folder)
    write_text(
        folder / "worth.json", json.dumps(OmegaConf.to_container(config.worth, resolve=True), indent=1) + "\n"
    )
    (folder / "weights").mkdir(exist_ok=True)
    jobs = list(_jobs(config, overrides, folder, done={course.key for course in courses.all}))
    with runner(config.worth.workers, "cpu", run_job) as run:
        run_all(run, jobs, courses, config.worth.name)


def _jobs(config: DictConfig, overrides: Sequence[str], folder: Path, done: set[Any]) -> Iterator[Job]:
    worth = config.worth
    for data_name in worth.only or worth.data_sets:
        data_set = worth.data_sets[data_name]
        n_reported, n_choosing, n_points = (data_set.get(k, worth[k]) for k in ("replicas", "choosing", "points"))
        for method_name in data_set.get("methods", worth.methods):
            method = worth.methods[method_name]
            passes = max(1, round(data_set.passes * method.get("longer", 1)))
            own_overrides = (*method.overrides, *data_set.overrides)
            schedule = _schedule(composed_for(tuple(overrides), own_overrides), passes, method)
            composed = composed_for(tuple(overrides), (*own_overrides, *_run_settings(schedule.iterations)))
            for rate in data_set.get("rates", method.get("rates", worth.rates)):
                if (data_name, method_name, rate) in done:
                    continue
                own: Any = OmegaConf.to_container(composed, resolve=False)
                own["pretrain"] = {**own["pretrain"], "optimizer": {**own["pretrain"]["optimizer"], "lr": rate}}
                yield Job(
                    str(data_name),
                    str(method_name),
                    float(rate),
                    str(folder),
                    own,
                    plan_of,
                    n_reported,
                    n_choosing,
                    _points(schedule.passes, n_points),
                    data_set.measure,
                    worth.gradient_draws,
                    schedule.greedy_passes,
                )


class _Schedule(NamedTuple):
    """Passes of one method.

    Attributes:
        iterations: Of a layer, or of all layers together.
        greedy_passes: Of each layer, before joint training.
        passes: All together.
    """

    iterations: int
    greedy_passes: int
    passes: int


def _schedule(composed: DictConfig, passes: int, method: DictConfig) -> _Schedule:
    """Share passes out to layers, so that methods of many layers and of one have about as many updates."""
    target, layers = composed.pretrain.stage["_target_"], len(composed.model.get("hidden_sizes", [0]))
    if target.endswith(".Greedy"):
        each = max(1, passes // layers)
        return _Schedule(each, 0, each * layers)
    greedy = round(passes * method.get("greedy_start", 0.0) / layers)
    joint = max(1, passes - greedy * layers)
    return _Schedule(joint, greedy, greedy * layers + joint)


def _run_settings(passes: int) -> tuple[str, ...]:
    """No fine-tuning, plain gradient descent at a rate that falls to a hundredth."""
    decay = "{_target_:memcomp_lightning.training.LearningRateDecay,n_passes:" + str(passes) + "}"
    return (
        f"pretrain.iterations={passes}",
        "finetune.iterations=0",
        "pretrain.schedules.momentum=null",
        f"pretrain.schedules.decay={decay}",
    )


def _points(passes: int, n: int) -> tuple[int, ...]:
    """Passes that are about evenly spaced in the logarithm, the last one included."""
    spaced = [round(passes ** (k / (n - 1))) for k in range(n)] if n > 1 else [passes]
    return tuple(dict.fromkeys(spaced))
