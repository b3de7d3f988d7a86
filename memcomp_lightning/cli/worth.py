"""``experiment=sampler_worth``: RBMs trained by many samplers, measured by their likelihood along the way."""

import copy
import json
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from memcomp_lightning import rng
from memcomp_lightning.cli.build import build
from memcomp_lightning.cli.errors import UserError
from memcomp_lightning.cli.figures import composed_for
from memcomp_lightning.cli.units import Progress, rates_of
from memcomp_lightning.cli.workers import run_all, runner
from memcomp_lightning.cli.worth_measures import (
    MEASURES,
    gradient_bias,
    mean_gradient,
    measure_of,
    without_diverged,
)
from memcomp_lightning.errors import SettingError, require, require_choice, require_count
from memcomp_lightning.files import write_text, written_whole
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.modules import DBNPretraining, DivergedError
from memcomp_lightning.replicas import pretrain_layer, stacked
from memcomp_lightning.report.worth import Course, Courses, weights_path
from memcomp_lightning.samplers import positive_phase

DATA_SETTINGS = ("label", "overrides", "passes", "measure", "methods", "rates", "replicas", "choosing", "points")
METHOD_SETTINGS = ("label", "overrides", "longer", "rates")


@dataclass(frozen=True)
class Job:
    """All replicas of one method at one learning rate on one data set.

    Attributes:
        data_set: Name of the data set.
        method: Name of the method.
        rate: Learning rate of the first update.
        folder: Of the run: final weights go there.
        config: Settings as plain values, those of a single run.
        n_reported: Seeds 0 to n - 1, side by side.
        n_choosing: Further seeds, scored on images that the reported ones do not see where there are such.
        points: Passes after which the RBMs are measured.
        measure: A key of ``MEASURES``.
        gradient_draws: Draws of the negative phase whose mean gradient is compared with the exact one.
    """

    data_set: str
    method: str
    rate: float
    folder: str
    config: dict[str, Any]
    n_reported: int
    n_choosing: int
    points: tuple[int, ...]
    measure: str
    gradient_draws: int

    @property
    def n_replicas(self) -> int:
        """All of them."""
        return self.n_reported + self.n_choosing

    @property
    def n_updates(self) -> int:
        """Of the progress bar: passes."""
        return self.points[-1]

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.data_set}, {self.method}, lr = {self.rate:g}"


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
    for kind, known in (("data_sets", DATA_SETTINGS), ("methods", METHOD_SETTINGS)):
        for name, settings in worth[kind].items():
            for key in settings:
                require_choice(f"setting of worth.{kind}.{name}", str(key), known)
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
        plan = build(OmegaConf.create(job.config))
        stage, rbm = plan.pretraining, _dbn(plan.network)[0]
        assert stage is not None
        partitions = stage.data.replicas
        require(partitions == (), "data.partitions", partitions, "1: replicas are seeds here")
        if (job.data_set, job.method) not in seen:
            seen.add((job.data_set, job.method))
            measure = measure_of(job.measure, stage.data, 1)
            if job.measure != "ais":  # which refuses no RBM, and takes its time
                measure(stacked([rbm], ()))


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
            composed = composed_for(
                tuple(overrides), (*data_set.overrides, *method.overrides, *_run_settings(passes))
            )
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
                    n_reported,
                    n_choosing,
                    _points(passes, n_points),
                    data_set.measure,
                    worth.gradient_draws,
                )


def _run_settings(passes: int) -> tuple[str, ...]:
    """No fine-tuning, plain gradient descent at a rate that falls to a hundredth."""
    decay = "{_target_:memcomp_lightning.callbacks.LearningRateDecay,n_passes:" + str(passes) + "}"
    return (
        f"pretrain.iterations={passes}",
        "finetune.iterations=0",
        "callbacks.pretrain.momentum_schedule=null",
        f"+callbacks.pretrain.learning_rate_decay={decay}",
    )


def _points(passes: int, n: int) -> tuple[int, ...]:
    """Passes that are about evenly spaced in the logarithm, the last one included."""
    spaced = [round(passes ** (k / (n - 1))) for k in range(n)] if n > 1 else [passes]
    return tuple(dict.fromkeys(spaced))


def run_job(job: Job, progress: Progress) -> list[Course]:
    """Train the replicas of a job side by side and measure them; measurements do not count as time.

    On one thread, and seconds are those of the processor: methods are compared by them while others run beside.
    """
    torch.set_num_threads(1)
    config = OmegaConf.create(job.config)
    plans = []
    for seed in range(job.n_replicas):
        config.seed = seed
        plans.append(build(config))
    stage = plans[0].pretraining
    assert stage is not None
    module = stage.module
    assert isinstance(module, DBNPretraining)
    dbn = stacked([_dbn(plan.network) for plan in plans], ())
    batches = stage.data.train_batches(0, 1).repeated(range(job.n_replicas))
    _warm_up(dbn[0], module.sampler, next(iter(batches)).v)
    passes = pretrain_layer(
        dbn,
        0,
        batches,
        module.sampler,
        iterations=job.points[-1],
        rates=rates_of(stage),
        centring=module.centring,
        generator=rng.stream(0, "negative_phase"),
    )
    measure, seconds = measure_of(job.measure, stage.data, job.n_reported), 0.0
    begin, reported = time.process_time(), 0
    course = Course(job.data_set, job.method, job.rate)
    updates_a_pass = sum(batch.closes_step for batch in batches)
    try:
        for done in passes:
            if done.number not in job.points:
                continue
            seconds += time.process_time() - begin
            progress(f"{job.title}, pass {done.number} of {job.points[-1]}", done.number - reported)
            reported = done.number
            rbm, diverged = without_diverged(dbn[0])
            course.add(
                done.number * updates_a_pass,
                seconds,
                [
                    None if values is None else values.double().masked_fill(diverged, math.inf).tolist()
                    for values in measure(rbm)
                ],
                [values.tolist() for values in gradient_bias(rbm, module.sampler, done, job.gradient_draws)],
            )
            begin = time.process_time()
    except (DivergedError, SettingError):  # the second is a solver's that is given NaN
        worst, nothing = [math.inf] * job.n_replicas, [math.nan] * job.n_replicas
        scores = [worst, worst if job.measure == "ais" else None]
        for point in job.points[len(course.updates) :]:
            course.add(point * updates_a_pass, seconds, scores, [nothing, nothing])
    with written_whole(weights_path(Path(job.folder), course)) as path:
        torch.save(dbn[0].state_dict(), path)
    return [course]


def _warm_up(rbm: RBM, sampler: Any, v: torch.Tensor) -> None:
    """Compile and load what the first updates need, outside the time that is compared."""
    positive, generator = positive_phase(rbm, v), rng.stream(0, "warm-up")
    state = sampler.init(rbm, v.shape[-2], generator=generator)
    mean_gradient(copy.deepcopy(rbm), sampler, state, positive, 1, generator=generator)


def _dbn(network: torch.nn.Module) -> DBN:
    require(isinstance(network, DBN), "model", type(network).__name__, "a DBN (model=dbn)")
    assert isinstance(network, DBN)
    return network
