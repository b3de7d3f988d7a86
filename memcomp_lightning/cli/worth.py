"""``experiment=sampler_worth``: RBMs trained by many samplers, measured by their likelihood along the way."""

import copy
import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.gradient_bias import MAX_UNITS, compared, gradient
from memcomp_lightning.cli.build import Stage, build
from memcomp_lightning.cli.errors import UserError
from memcomp_lightning.cli.figures import composed_for
from memcomp_lightning.cli.units import Progress, rates_of
from memcomp_lightning.cli.workers import run_all, runner
from memcomp_lightning.errors import SettingError, require, require_choice, require_count
from memcomp_lightning.files import write_text
from memcomp_lightning.likelihood import kl_divergence, log_likelihood, log_partition_function
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.modules import DBNPretraining, DivergedError
from memcomp_lightning.modules.stage import LARGEST_WEIGHT
from memcomp_lightning.replicas import Pass, pretrain_layer, stacked
from memcomp_lightning.report.worth import Course, Courses
from memcomp_lightning.samplers import Exact, positive_phase

DATA_SETTINGS = ("label", "overrides", "passes", "measure")
METHOD_SETTINGS = ("label", "overrides", "longer")


@dataclass(frozen=True)
class Job:
    """All replicas of one method at one learning rate on one data set.

    Attributes:
        data_set: Name of the data set.
        method: Name of the method.
        rate: Learning rate of the first update.
        config: Settings as plain values, those of a single run.
        n_replicas: Seeds 0 to n - 1, side by side.
        points: Passes after which the RBMs are measured.
        measure: ``kl`` or ``log_likelihood``.
        gradient_draws: Draws of the negative phase whose mean gradient is compared with the exact one.
    """

    data_set: str
    method: str
    rate: float
    config: dict[str, Any]
    n_replicas: int
    points: tuple[int, ...]
    measure: str
    gradient_draws: int

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
            "preset=quick is one of figures: make the comparison smaller with worth.rates=[...], worth.replicas=N "
            "or ~worth.data_sets.NAME."
        )
    for key in ("replicas", "choosing", "points", "gradient_draws"):
        require_count(f"worth.{key}", worth[key])
    require(len(worth.rates) > 0, "worth.rates", list(worth.rates), "at least one learning rate")
    for kind, known in (("data_sets", DATA_SETTINGS), ("methods", METHOD_SETTINGS)):
        for name, settings in worth[kind].items():
            for key in settings:
                require_choice(f"setting of worth.{kind}.{name}", str(key), known)
    for name, data_set in worth.data_sets.items():
        require_choice(f"worth.data_sets.{name}.measure", data_set.measure, tuple(_MEASURES))
    for name in (*worth.claimed, *worth.baselines):
        require_choice("worth.claimed and worth.baselines", name, tuple(worth.methods))
    if worth.workers is not None:
        require_count("worth.workers", worth.workers)
    require_choice("trainer.accelerator", config.trainer.accelerator, ("auto", "cpu"))
    for job in _jobs(config, overrides, done=set()):
        plan = build(OmegaConf.create(job.config))
        stage, rbm = plan.pretraining, _dbn(plan.network)[0]
        assert stage is not None
        partitions = stage.data.replicas
        require(partitions == (), "data.partitions", partitions, "1: replicas are seeds here")
        if job.rate == worth.rates[0]:
            _MEASURES[job.measure](stage)(rbm)


def train_worth(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Train what is missing; each course is written when it exists."""
    courses = Courses(folder)
    write_text(
        folder / "worth.json", json.dumps(OmegaConf.to_container(config.worth, resolve=True), indent=1) + "\n"
    )
    jobs = list(_jobs(config, overrides, done={course.key for course in courses.all}))
    with runner(config.worth.workers, "cpu", run_job) as run:
        run_all(run, jobs, courses, config.worth.name)


def _jobs(config: DictConfig, overrides: Sequence[str], done: set[Any]) -> Iterator[Job]:
    worth = config.worth
    for data_name, data_set in worth.data_sets.items():
        for method_name, method in worth.methods.items():
            passes = max(1, round(data_set.passes * method.get("longer", 1)))
            composed = composed_for(
                tuple(overrides), (*data_set.overrides, *method.overrides, *_run_settings(passes))
            )
            for rate in worth.rates:
                if (data_name, method_name, rate) in done:
                    continue
                own: Any = OmegaConf.to_container(composed, resolve=False)
                own["pretrain"] = {**own["pretrain"], "optimizer": {**own["pretrain"]["optimizer"], "lr": rate}}
                yield Job(
                    str(data_name),
                    str(method_name),
                    float(rate),
                    own,
                    worth.replicas + worth.choosing,
                    _points(passes, worth.points),
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

    On one thread: seconds of different methods are compared.
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
    measure, seconds, begin, reported = _MEASURES[job.measure](stage), 0.0, time.perf_counter(), 0
    course = Course(job.data_set, job.method, job.rate, [], [], [], [], [])
    updates_a_pass = sum(batch.closes_step for batch in batches)
    try:
        for done in passes:
            if done.number not in job.points:
                continue
            seconds += time.perf_counter() - begin
            progress(f"{job.title}, update {done.number} of {job.points[-1]}", done.number - reported)
            reported = done.number
            rbm, diverged = without_diverged(dbn[0])
            cosine, error = gradient_bias(rbm, module.sampler, done, job.gradient_draws)
            score = measure(rbm).double().masked_fill(diverged, math.inf)
            course.updates.append(done.number * updates_a_pass)
            course.seconds.append(seconds)
            course.scores.append(score.tolist())
            course.cosines.append(cosine.tolist())
            course.errors.append(error.tolist())
            begin = time.perf_counter()
    except (DivergedError, SettingError):  # the second is a solver's that is given NaN
        for updates in job.points[len(course.updates) :]:
            course.updates.append(updates * updates_a_pass)
            course.seconds.append(seconds)
            course.scores.append([math.inf] * job.n_replicas)
            course.cosines.append([math.nan] * job.n_replicas)
            course.errors.append([math.nan] * job.n_replicas)
    return [course]


@torch.no_grad()
def without_diverged(rbm: RBM) -> tuple[RBM, Tensor]:
    """A copy in which replicas that left the finite numbers are zero, and which they are, ``(*replicas,)``."""
    n = len(rbm.replicas)
    largest = torch.stack([p.flatten(n).abs().amax(-1).nan_to_num(nan=math.inf) for p in rbm.parameters()]).amax(0)
    diverged = largest > LARGEST_WEIGHT
    kept = copy.deepcopy(rbm)
    for parameter in kept.parameters():
        parameter.masked_fill_(diverged.view((*diverged.shape, *[1] * (parameter.ndim - n))), 0.0)
    return kept, diverged


@torch.no_grad()
def gradient_bias(rbm: RBM, sampler: Any, done: Pass, n_draws: int) -> tuple[Tensor, Tensor]:
    """Cosine and relative error of a sampler's mean gradient against the exact one, ``(*replicas,)`` each.

    Of the mean over some draws from the sampler's present state: noise of the draws is small in it, that of where
    persistent chains are is not, and a coin of small probability comes up in few of them. NaN where the smaller
    layer is too large.
    """
    exact, generator = Exact(max_units=MAX_UNITS), rng.stream(done.number, "gradient bias")
    if min(rbm.n_visible, rbm.n_hidden) > exact.max_units:
        nothing = torch.full(rbm.replicas, math.nan)
        return nothing, nothing
    positive = positive_phase(rbm, done.positive.v)

    def of(sampler: Any, state: Any) -> Tensor:
        negative = sampler.sample(rbm, state, positive, generator=generator).configurations
        return gradient(rbm, positive, negative).double()

    true = of(exact, exact.init(rbm, 1, generator=generator))
    mean = torch.stack([of(sampler, done.state) for _ in range(1 if sampler.shared else n_draws)]).mean(0)
    return compared(mean, true)


def _dbn(network: torch.nn.Module) -> DBN:
    require(isinstance(network, DBN), "model", type(network).__name__, "a DBN (model=dbn)")
    assert isinstance(network, DBN)
    return network


def _kl(stage: Stage) -> Callable[[RBM], Tensor]:
    v = stage.data.images.train_v
    return lambda rbm: kl_divergence(rbm, v)


def _log_likelihood(stage: Stage) -> Callable[[RBM], Tensor]:
    """Negative, so that less is better, as for the divergence: nats an image."""
    v = stage.data.images.test_v
    return lambda rbm: -log_likelihood(rbm, v, log_partition_function(rbm)).mean(-1)


_MEASURES = {"kl": _kl, "log_likelihood": _log_likelihood}
