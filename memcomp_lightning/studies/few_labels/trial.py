"""A pretraining without labels, whose weights are kept, and a method with one draw of labels."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from memcomp_lightning.ambient import in_one_thread
from memcomp_lightning.errors import require
from memcomp_lightning.models import DBN
from memcomp_lightning.modules.weights import save_weights
from memcomp_lightning.studies.accuracy import Progress
from memcomp_lightning.studies.few_labels.data import drawn, folded, whole
from memcomp_lightning.studies.few_labels.learner import Context, Learner, weight_file
from memcomp_lightning.studies.few_labels.settings import FewLabels
from memcomp_lightning.studies.few_labels.tuning import cross_validated
from memcomp_lightning.studies.plan import Plan, Trial, images_of, passes_without_trainer, pretraining_of
from memcomp_lightning.studies.records import Record

PRETRAINING = "pretraining"
"""In the place of a data set, in records of pretrainings."""

CHOSEN = "chosen "
"""Begins the measures that say what cross-validation chose."""


@dataclass(frozen=True, kw_only=True)
class PretrainingTrial(Trial):
    """A DBN that learns from all training rows without labels.

    Attributes:
        folder: Of the weights.
        way: What trains it in the place of its run.
    """

    folder: str
    way: Any = None

    @property
    def n_updates(self) -> int:
        """Of the progress bar: it counts trials."""
        return 1

    @property
    def title(self) -> str:
        """For people."""
        return f"pretraining {self.method}, seed {self.seed}"

    @in_one_thread()
    def run(self, progress: Progress) -> list[Record]:
        """Train, and leave the weights and a record of the time."""
        assert self.seed is not None
        plan = self.build({**self.settings, "seed": self.seed})
        dbn, (stage, module) = dbn_of(plan), pretraining_of(plan)
        begin, done = time.process_time(), 0

        def say(passes: int) -> None:
            nonlocal done
            done = passes
            progress(f"{self.title}, pass {passes}", 0)

        if self.way is None:
            for each in passes_without_trainer(module, stage.data.train_batches(0, 1), seed=self.seed):
                say(each.number)
        else:
            self.way.train(dbn, stage.data.train[0], self.seed, say)
        seconds = time.process_time() - begin
        save_weights(dbn, weight_file(Path(self.folder), self.method, self.seed))
        progress(self.title, 1)
        return [Record.of(self, at=[done], seconds=[seconds], measures={})]


@dataclass(frozen=True, kw_only=True)
class LabelsTrial(Trial):
    """A method that is tuned by cross-validation inside the labels, and then judged once by the test rows.

    Attributes:
        learner: The method.
        study: What it is part of.
        folder: Of the pretrained weights; draws take those of the seeds in turn.
        base: What was chosen for the method that this one goes on from.
    """

    learner: Learner
    study: FewLabels
    folder: str
    base: dict[str, float] | None = None

    @property
    def n_updates(self) -> int:
        """Of the progress bar: it counts trials."""
        return 1

    @property
    def title(self) -> str:
        """For people."""
        n = "all" if self.labels is None else self.labels
        return f"{self.method}, {n} labels, draw {self.seed}"

    @in_one_thread()
    def run(self, progress: Progress) -> list[Record]:
        """Tune, learn from all labels, test; seconds are those of the processor, tuning included."""
        progress(self.title, 0)
        assert self.seed is not None
        draw = self.seed
        plan = self.build({**self.settings, "seed": draw})
        data = images_of(pretraining_of(plan)[0])
        (rows, label), test = data.train, _with_label(data.test)
        own, begin = drawn(label, self.labels, draw), time.process_time()
        context = Context(
            blank=dbn_of(plan),
            pretraining=self.study.methods[self.method].pretraining,
            folder=Path(self.folder),
            pretrained_by=draw % self.study.pretrainings,
            seed=draw,
            lengths=self.study.lengths,
            rows=rows,
            base=self.base,
        )
        folds = folded(rows, own, self.study.n_folds(len(own.at)), data.n_classes, draw)
        search = self.study.searches[self.study.methods[self.method].search]
        chosen = cross_validated(self.learner, context, folds, search.axes, search.start)
        everything = whole(rows, own, test, data.n_classes, draw)
        points = self.learner.learn(context, everything, chosen.setting, (chosen.passes,))
        accuracy = float(points[-1].accuracy[0]) if points else 0.0
        measures = {"test_accuracy": [[accuracy]], "cross_validated": [[chosen.accuracy]]}
        measures |= {"labels": [[float(len(own.at))]]}
        measures |= {"tried": [[float(chosen.tried)]], f"{CHOSEN}passes": [[float(chosen.passes)]]}
        measures |= {f"{CHOSEN}{name}": [[float(value)]] for name, value in chosen.setting.items()}
        seconds = time.process_time() - begin
        progress(self.title, 1)
        record = Record.of(self, at=[chosen.passes], seconds=[seconds], measures=measures)
        return [replace(record, held_out=chosen.accuracy)]


def chosen_of(record: Record) -> dict[str, float]:
    """The setting that cross-validation chose, with its passes."""
    return {
        name.removeprefix(CHOSEN): values[0][0]
        for name, values in record.measures.items()
        if name.startswith(CHOSEN)
    }


def dbn_of(plan: Plan) -> DBN:
    """The DBN of a plan.

    Raises:
        SettingError: It has another network.
    """
    network = plan.network
    require(isinstance(network, DBN), "model", type(network).__name__, "model=dbn")
    assert isinstance(network, DBN)
    return network


def _with_label(rows: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    v, label = rows
    known = torch.nonzero(label >= 0).flatten()
    return v[known], label[known]
