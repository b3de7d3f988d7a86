"""Trials that are measured by likelihood: replicas of one method side by side, measured between passes."""

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.ambient import in_one_thread
from memcomp_lightning.errors import SettingError
from memcomp_lightning.files import written_whole
from memcomp_lightning.models import DBM, DBN, stacked
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import positive_phase
from memcomp_lightning.studies.accuracy import Progress
from memcomp_lightning.studies.measures import MEASURES
from memcomp_lightning.studies.measures.gradient_bias import gradient_bias, mean_gradient, without_diverged
from memcomp_lightning.studies.plan import Plan, Stage
from memcomp_lightning.studies.worth import Course, weights_path
from memcomp_lightning.training import Batches, DivergedError, Greedy, Pass, pretrain


@dataclass(frozen=True)
class Job:
    """All replicas of one method at one learning rate on one data set.

    Attributes:
        data_set: Name of the data set.
        method: Name of the method.
        rate: Learning rate of the first update.
        folder: Of the run: final weights go there.
        settings: Of a single run, as plain values.
        build: Makes the objects of a run from its settings; a function of a module, which processes can import.
        n_reported: Seeds 0 to n - 1, side by side.
        n_choosing: Further seeds, scored on images that the reported ones do not see where there are such.
        points: Passes after which the RBMs are measured.
        measure: A key of ``MEASURES``.
        gradient_draws: Draws of the negative phase whose mean gradient is compared with the exact one.
        greedy_passes: Passes for each layer that come before joint training.
    """

    data_set: str
    method: str
    rate: float
    folder: str
    settings: dict[str, Any]
    build: Callable[[dict[str, Any]], Plan]
    n_reported: int
    n_choosing: int
    points: tuple[int, ...]
    measure: str
    gradient_draws: int
    greedy_passes: int = 0

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


class Training(NamedTuple):
    """A training under way.

    Attributes:
        passes: Trains; what is done, pass by pass.
        model: The energy model as it is now.
    """

    passes: Iterator[Pass]
    model: Callable[[], Any]


def module_of(plan: Plan) -> tuple[Stage, EnergyPretraining]:
    """The pretraining of a plan."""
    stage = plan.pretraining
    assert stage is not None
    assert isinstance(stage.module, EnergyPretraining)
    return stage, stage.module


def side_by_side(plans: Sequence[Plan]) -> Any:
    """The networks of plans as one with a replica axis: a DBN, or a Boltzmann machine."""
    return stacked([plan.network for plan in plans], ())


def model_of(network: Any) -> Any:
    """The energy model that a network is: itself, its only RBM, or the DBM of its layers."""
    if not isinstance(network, DBN):
        return network
    return network[0] if len(network) == 1 else DBM.from_dbn(network)


def run_job(job: Job, progress: Progress) -> list[Course]:
    """Train the replicas of a job side by side and measure them; measurements do not count as time.

    On one thread, and seconds are those of the processor: methods are compared by them while others run beside.
    """
    with in_one_thread():
        return _run_job(job, progress)


def _run_job(job: Job, progress: Progress) -> list[Course]:
    plans = [job.build({**job.settings, "seed": seed}) for seed in range(job.n_replicas)]
    stage, module = module_of(plans[0])
    network = side_by_side(plans)
    batches = stage.data.train_batches(0, 1).repeated(range(job.n_replicas))
    _warm_up(model_of(network), module, next(iter(batches)).v)
    measure, seconds = MEASURES[job.measure](stage.data, job.n_reported), 0.0
    begin, reported = time.process_time(), 0
    training = _training(job, plans[0], network, batches)
    course = Course(job.data_set, job.method, job.rate)
    updates_a_pass = sum(batch.closes_step for batch in batches)
    try:
        for done in training.passes:
            if done.number not in job.points:
                continue
            seconds += time.process_time() - begin
            progress(f"{job.title}, pass {done.number} of {job.points[-1]}", done.number - reported)
            reported = done.number
            model, diverged = without_diverged(training.model())
            bias = gradient_bias(model, module.sampler, done, job.gradient_draws)
            course.add(
                done.number * updates_a_pass,
                seconds,
                [
                    None if values is None else values.double().masked_fill(diverged, math.inf).tolist()
                    for values in measure(model)
                ],
                [values.tolist() for values in bias],
            )
            begin = time.process_time()
    except (DivergedError, SettingError):  # the second is a solver's that is given NaN
        worst, nothing = [math.inf] * job.n_replicas, [math.nan] * job.n_replicas
        scores = [worst, worst if job.measure == "ais" else None]
        measured = course.updates[-1] if course.updates else 0
        for updates in (point * updates_a_pass for point in job.points):
            if updates > measured:
                course.add(updates, seconds, scores, [nothing, nothing])
    with written_whole(weights_path(Path(job.folder), course)) as path:
        torch.save(training.model().state_dict(), path)
    return [course]


def _training(job: Job, plan: Plan, network: Any, batches: Batches) -> Training:
    """Layer by layer, or all units at once."""
    module = module_of(plan)[1]
    settings: dict[str, Any] = {
        "optimizer": module.make_optimizer,
        "schedules": module.schedules,
        "centring": module.centring,
    }
    done = 0
    if job.greedy_passes:
        for before in pretrain(Greedy(network), batches, module.sampler, iterations=job.greedy_passes, **settings):
            done = before.number
    assert plan.stage_for is not None
    stage = plan.stage_for(network)
    passes = pretrain(stage, batches, module.sampler, iterations=module.iterations, **settings)
    return Training(
        (after._replace(number=done + after.number) for after in passes),
        lambda: stage.phases[0].model if len(stage.phases) == 1 else model_of(network),
    )


def _warm_up(model: Any, module: EnergyPretraining, v: Tensor) -> None:
    """Compile and load what the first updates need, outside the time that is compared."""
    generator = rng.stream(0, "warm-up")
    positive = positive_phase(model, v)
    state = module.sampler.init(model, v.shape[-2], generator=generator)
    mean_gradient(copy.deepcopy(model), module.sampler, state, positive, 1, generator=generator)
