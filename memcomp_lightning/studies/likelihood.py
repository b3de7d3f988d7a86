"""Trials that are measured by likelihood: replicas of one method side by side, measured between passes."""

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.ambient import in_one_thread
from memcomp_lightning.errors import SettingError
from memcomp_lightning.files import written_whole
from memcomp_lightning.models import joint_model, stacked
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import positive_phase
from memcomp_lightning.studies.accuracy import Progress
from memcomp_lightning.studies.measures import MEASURES
from memcomp_lightning.studies.measures.gradient_bias import gradient_bias, mean_gradient, without_diverged
from memcomp_lightning.studies.plan import Plan, Stage, passes_without_trainer
from memcomp_lightning.studies.records import Key, Record
from memcomp_lightning.training import Batches, DivergedError, Greedy, Pass


@dataclass(frozen=True)
class LikelihoodTrial:
    """All replicas of one method at one learning rate on one data set.

    Attributes:
        data_set: Name of the data set.
        method: Name of the method.
        value: Learning rate of the first update; held-out data choose one.
        folder: Of the run: final weights go there.
        settings: Of a single run, as plain values.
        build: Makes the objects of a run from its settings; a function of a module, which processes can import.
        n_reported: Seeds 0 to n - 1, side by side.
        n_choosing: Further seeds that choose the learning rate; likelihoods score them by held-out images.
        points: Passes after which the RBMs are measured.
        measure: A key of ``MEASURES``.
        gradient_draws: Draws of the negative phase whose mean gradient is compared with the exact one.
        greedy_passes: Passes for each layer that come before joint training.
    """

    data_set: str
    method: str
    value: float
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
        return f"{self.data_set}, {self.method}, lr = {self.value:g}"

    @property
    def key(self) -> Key:
        """Of the record that it leaves."""
        return self.data_set, self.method, self.value, None, None, False

    def run(self, progress: Progress) -> list[Record]:
        """Train the replicas side by side and measure them; measurements do not count as time.

        It runs on one thread and counts seconds of the processor, so that methods can be compared by time while
        other trials run beside.
        """
        with in_one_thread():
            return self._run(progress)

    def _run(self, progress: Progress) -> list[Record]:
        plans = [self.build({**self.settings, "seed": seed}) for seed in range(self.n_replicas)]
        stage, module = pretraining_of(plans[0])
        network = stacked([plan.network for plan in plans], ())
        batches = stage.data.train_batches(0, 1).repeated(range(self.n_replicas))
        _warm_up(joint_model(network), module, next(iter(batches)).v)
        measure, seconds = MEASURES[self.measure], 0.0
        score = measure.make(stage.data, self.n_reported)
        begin, reported = time.process_time(), 0
        training = _training(self, plans[0], network, batches)
        names = ["score", "reverse"][: 1 + measure.both_ways]
        record = Record(
            data_set=self.data_set,
            method=self.method,
            value=self.value,
            at=[],
            seconds=[],
            measures={name: [] for name in (*names, "cosine", "relative_error")},
        )
        updates_a_pass = sum(batch.closes_step for batch in batches)
        try:
            for done in training.passes:
                if done.number not in self.points:
                    continue
                seconds += time.process_time() - begin
                progress(f"{self.title}, pass {done.number} of {self.points[-1]}", done.number - reported)
                reported = done.number
                model, diverged = without_diverged(training.model())
                scores = [x.double().masked_fill(diverged, math.inf) for x in score(model) if x is not None]
                bias = gradient_bias(model, module.sampler, done, self.gradient_draws)
                _add(record, done.number * updates_a_pass, seconds, [x.tolist() for x in (*scores, *bias)])
                begin = time.process_time()
        except (DivergedError, SettingError):  # the second is a solver's that is given NaN
            worst, nothing = [math.inf] * self.n_replicas, [math.nan] * self.n_replicas
            measured = record.at[-1] if record.at else 0
            for updates in (point * updates_a_pass for point in self.points):
                if updates > measured:
                    _add(record, updates, seconds, [*(worst for _ in names), nothing, nothing])
        record = replace(record, held_out=-float(np.median(record.measured("score")[-1, self.n_reported :])))
        with written_whole(weights_path(Path(self.folder), record)) as path:
            torch.save(training.model().state_dict(), path)
        return [record]


class Training(NamedTuple):
    """A training under way.

    Attributes:
        passes: Trains; what is done, pass by pass.
        model: The energy model as it is now.
    """

    passes: Iterator[Pass]
    model: Callable[[], Any]


def pretraining_of(plan: Plan) -> tuple[Stage, EnergyPretraining]:
    """The pretraining of a plan."""
    stage = plan.pretraining
    assert stage is not None
    assert isinstance(stage.module, EnergyPretraining)
    return stage, stage.module


def weights_path(folder: Path, record: Record) -> Path:
    """Final weights of a trial: a state dict of the model with its replicas, the reported ones first."""
    return folder / "weights" / f"{record.data_set}-{record.method}-{record.value:g}.pt"


def _add(record: Record, updates: int, seconds: float, values: Sequence[list[float]]) -> None:
    """Append a measurement: a list over replicas for each measure."""
    record.at.append(updates)
    record.seconds.append(seconds)
    for kept, new in zip(record.measures.values(), values, strict=True):
        kept.append(new)


def _training(trial: LikelihoodTrial, plan: Plan, network: Any, batches: Batches) -> Training:
    """Layer by layer, or all units at once."""
    module = pretraining_of(plan)[1]
    done = 0
    if trial.greedy_passes:
        greedy = Greedy(network)
        for before in passes_without_trainer(module, batches, stage=greedy, iterations=trial.greedy_passes):
            done = before.number
    assert plan.stage_for is not None
    stage = plan.stage_for(network)
    passes = passes_without_trainer(module, batches, stage=stage)
    return Training(
        (after._replace(number=done + after.number) for after in passes),
        lambda: stage.phases[0].model if len(stage.phases) == 1 else joint_model(network),
    )


def _warm_up(model: Any, module: EnergyPretraining, v: Tensor) -> None:
    """Compile and load what the first updates need, outside the time that is compared."""
    generator = rng.stream(0, "warm-up")
    positive = positive_phase(model, v)
    state = module.sampler.init(model, v.shape[-2], generator=generator)
    mean_gradient(copy.deepcopy(model), module.sampler, state, positive, 1, generator=generator)
