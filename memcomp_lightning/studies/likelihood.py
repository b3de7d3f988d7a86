"""Trials that are measured by likelihood: replicas of one method side by side, measured between passes."""

import copy
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.ambient import in_one_thread
from memcomp_lightning.errors import SettingError
from memcomp_lightning.files import inside
from memcomp_lightning.models import joint_model, stacked
from memcomp_lightning.modules import EnergyPretraining, save_weights
from memcomp_lightning.samplers import positive_phase
from memcomp_lightning.studies.accuracy import Progress
from memcomp_lightning.studies.measures import MEASURES
from memcomp_lightning.studies.measures.gradient_bias import gradient_bias, mean_gradient, without_diverged
from memcomp_lightning.studies.plan import Plan, Trial, images_of, passes_without_trainer, pretraining_of
from memcomp_lightning.studies.records import Measures, Record
from memcomp_lightning.studies.worth import Comparison
from memcomp_lightning.training import Batches, DivergedError, Greedy, Pass


@dataclass(frozen=True, kw_only=True)
class LikelihoodTrial(Trial):
    """All replicas of one method at one learning rate on one data set.

    Attributes:
        value: Learning rate of the first update; held-out data choose one.
        comparison: What it is part of.
        folder: Of the run: final weights go there.
        points: Passes after which the RBMs are measured.
        greedy_passes: Passes for each layer that come before joint training.
    """

    value: float
    comparison: Comparison
    folder: str
    points: tuple[int, ...]
    greedy_passes: int

    @property
    def n_updates(self) -> int:
        """Of the progress bar: passes."""
        return self.points[-1]

    @property
    def title(self) -> str:
        """For people."""
        return f"{self.data_set}, {self.method}, lr = {self.value:g}"

    @in_one_thread()
    def run(self, progress: Progress) -> list[Record]:
        """Train the replicas side by side and measure them; measurements do not count as time.

        It runs on one thread and counts seconds of the processor, so that methods can be compared by time while
        other trials run beside.
        """
        n_reported = self.comparison.n_reported(self.data_set)
        n_replicas = n_reported + self.comparison.n_choosing(self.data_set)
        plans = [self.build({**self.settings, "seed": seed}) for seed in range(n_replicas)]
        stage, module = pretraining_of(plans[0])
        network = stacked([plan.network for plan in plans], ())
        batches = stage.data.train_batches(0, 1).repeated(range(n_replicas))
        warm_up(joint_model(network), module, next(iter(batches)).v)
        measure, seconds = MEASURES[self.comparison.data_sets[self.data_set].measure], 0.0
        score = measure.make(images_of(stage), n_reported)
        passes, present_model = _training(self, plans[0], network, batches)
        names = ["score", "reverse"][: 1 + measure.both_ways]
        measures: Measures = {name: [] for name in (*names, "cosine", "relative_error")}
        record = Record.of(self, at=[], seconds=[], measures=measures)
        updates_a_pass = sum(batch.closes_step for batch in batches)
        try:
            for done, seconds in measured_passes(passes, self.points, progress, self.title):
                model, diverged = without_diverged(present_model())
                scores = [x.double().masked_fill(diverged, math.inf) for x in score(model) if x is not None]
                bias = gradient_bias(model, module.sampler, done, self.comparison.gradient_draws)
                _add(record, done.number * updates_a_pass, seconds, [x.tolist() for x in (*scores, *bias)])
        except (DivergedError, SettingError):  # the second is a solver's that is given NaN
            worst, nothing = [math.inf] * n_replicas, [math.nan] * n_replicas
            measured = record.at[-1] if record.at else 0
            for updates in (point * updates_a_pass for point in self.points):
                if updates > measured:
                    _add(record, updates, seconds, [*(worst for _ in names), nothing, nothing])
        record = replace(record, held_out=-float(np.median(record.measured("score")[-1, n_reported:])))
        save_weights(present_model(), weights_path(Path(self.folder), record))
        return [record]


def weights_path(folder: Path, record: Record) -> Path:
    """Final weights of a trial: a state dict of the model with its replicas, the reported ones first."""
    return inside(folder / "weights", f"{record.data_set}-{record.method}-{record.value:g}.pt")


def _add(record: Record, updates: int, seconds: float, values: Sequence[list[float]]) -> None:
    """Append a measurement: a list over replicas for each measure."""
    record.at.append(updates)
    record.seconds.append(seconds)
    for kept, new in zip(record.measures.values(), values, strict=True):
        kept.append(new)


def _training(
    trial: LikelihoodTrial, plan: Plan, network: Any, batches: Batches
) -> tuple[Iterator[Pass], Callable[[], Any]]:
    """Passes, layer by layer or of all units at once, and what gives the model as it is after one of them."""
    module = pretraining_of(plan)[1]
    done = 0
    if trial.greedy_passes:
        greedy = Greedy(network)
        for before in passes_without_trainer(module, batches, stage=greedy, iterations=trial.greedy_passes):
            done = before.number
    assert plan.stage_for is not None
    stage = plan.stage_for(network)
    passes = (
        after._replace(number=done + after.number)
        for after in passes_without_trainer(module, batches, stage=stage)
    )
    return passes, lambda: stage.phases[0].model if len(stage.phases) == 1 else joint_model(network)


def measured_passes(
    passes: Iterable[Pass], points: Sequence[int], progress: Progress, title: str
) -> Iterator[tuple[Pass, float]]:
    """The passes after which is measured, and the seconds of the processor that training took until then.

    What is done between them does not count. The progress bar is moved, to its end when training ends.
    """
    seconds, begin, reported = 0.0, time.process_time(), 0
    try:
        for done in passes:
            if done.number in points:
                seconds += time.process_time() - begin
                progress(f"{title}, pass {done.number} of {points[-1]}", done.number - reported)
                reported = done.number
                yield done, seconds
                begin = time.process_time()
    finally:
        progress(title, points[-1] - reported)


def warm_up(model: Any, module: EnergyPretraining, v: Tensor) -> None:
    """Compile and load what the first updates need, outside the time that is compared."""
    generator = rng.stream(0, "warm-up")
    positive = positive_phase(model, v)
    state = module.sampler.init(model, v.shape[-2], generator=generator)
    mean_gradient(copy.deepcopy(model), module.sampler, state, positive, 1, generator=generator)
