"""Trials that are measured by accuracy, as those of figures, and their training side by side."""

import json
import math
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning.errors import require_count
from memcomp_lightning.models import stacked
from memcomp_lightning.studies.plan import (
    Plan,
    Trial,
    finetuning_of,
    finetuning_without_trainer,
    passes_without_trainer,
    pretraining_of,
)
from memcomp_lightning.studies.records import Measures, Record
from memcomp_lightning.training import DivergedError, evaluate
from memcomp_lightning.types import Batch

Progress = Callable[[str, int], None]
"""Takes what is being done, and how many network updates were done since the last call."""


@dataclass(frozen=True, kw_only=True)
class AccuracyTrial(Trial):
    """A network, with its replicas, that is pretrained, fine-tuned and tested."""

    seed: int

    @property
    def fine_tuning(self) -> str:
        """What networks must share to be fine-tuned as one program."""
        settings = self.settings
        shared = {name: settings[name] for name in ("data", "finetune", "trainer")}
        shared["network"] = [settings["model"]["_target_"], settings["model"]["hidden_sizes"]]
        if settings["finetune"]["labels"] is not None:
            shared["labels_of"] = self.seed
        return json.dumps(shared, sort_keys=True)

    def record(self, passes: Sequence[int], seconds: list[float], scores: Measures) -> Record:
        """What it leaves; held-out images judge by the mean over tested passes and replicas."""
        judged = float(np.mean(scores["validation_accuracy"])) if self.choosing else None
        record = Record.of(self, at=list(passes), seconds=seconds, measures=scores)
        return replace(record, held_out=judged)


@dataclass(frozen=True)
class SideBySide:
    """Trials of one :attr:`AccuracyTrial.fine_tuning`, whose networks are fine-tuned as one tensor program.

    They are tested after ``passes`` of it; ``n_updates`` counts those of all replicas.
    """

    trials: tuple[AccuracyTrial, ...]
    passes: tuple[int, ...]
    n_updates: int

    @property
    def title(self) -> str:
        """For people."""
        first, more = self.trials[0], len(self.trials) - 1
        what = f"choosing, {first.value:g}" if first.choosing else f"N = {first.iterations}"
        return f"{first.method}, {what}" + (f" and {more} more" if more else "")

    def run(self, progress: Progress) -> list[Record]:
        """Pretrain each network, fine-tune all of them side by side, test after the passes asked for.

        A value that is only tried may diverge: it is then no choice. Else a DivergedError names the curve.
        """
        device = device_of(self.trials[0].settings["trainer"]["accelerator"])
        trained, found = [], []
        for number, trial in enumerate(self.trials, start=1):
            progress(f"{self.title}, pretraining {number} of {len(self.trials)}", 0)
            begin = time.perf_counter()
            try:
                plan = pretrained(plan_of(trial, self.passes[-1]), trial.seed, device)
            except DivergedError as error:
                if not trial.choosing:
                    raise DivergedError(f"figure.curves.{trial.method}: {error}") from error
                nothing = {f"{name}_accuracy": [[0.0]] * len(self.passes) for name in ("test", "validation")}
                found.append(trial.record(self.passes, [time.perf_counter() - begin] * len(self.passes), nothing))
            else:
                trained.append((trial, plan, time.perf_counter() - begin))
        if not trained:
            return found
        trials, plans, pretrain_s = zip(*trained, strict=True)
        try:
            seconds, scores = self._fine_tuned(plans, trials, progress, device)
        except DivergedError as error:
            curves = ", ".join(dict.fromkeys(trial.method for trial in trials))
            raise DivergedError(f"figure.curves.{curves}: {error}") from error
        for number, trial in enumerate(trials):
            own = {name: values[:, number].tolist() for name, values in scores.items()}
            until = [pretrain_s[number] + each / len(trials) for each in seconds]
            found.append(trial.record(self.passes, until, own))
        return found

    def _fine_tuned(
        self, plans: Sequence[Plan], trials: Sequence[AccuracyTrial], progress: Progress, device: torch.device
    ) -> tuple[list[float], dict[str, Tensor]]:
        """Seconds by pass; scores by name, ``(n_passes, n_trials, n_replicas)``."""
        begin = time.perf_counter()
        stage, first = finetuning_of(plans[0])
        seeds = [trial.seed for trial in trials]
        n_trials, replicas = len(plans), stage.data.replicas
        network = stacked([finetuning_of(plan)[1].network for plan in plans], replicas).to(device)
        batches = stage.data.train_batches(0, 1).repeated(seeds).to(device)
        tests = {"test": stage.data.test, "validation": stage.data.validation}
        images = {name: _side_by_side(*held, n_trials, replicas, device) for name, held in tests.items() if held}
        scores = defaultdict(list)
        seconds = []
        n_updates = len(batches) * n_trials * math.prod(replicas)
        # Where several passes are tested, the best of these is found by the report.
        keeps_best = stage.judge is not None and (len(self.passes) == 1 or stage.judge.patience is not None)
        held_out = images["validation"] if keeps_best else None
        passes = finetuning_without_trainer(
            stage, network, batches, iterations=self.passes[-1], seeds=seeds, held_out=held_out
        )
        try:
            for done in passes:
                progress(f"{self.title}, pass {done} of {self.passes[-1]}", n_updates)
                if done in self.passes:
                    seconds.append(time.perf_counter() - begin)
                    for name, batch in images.items():
                        score = evaluate(network, [batch], first.loss)
                        scores[f"{name}_accuracy"].append(score.accuracy)
                        scores[f"{name}_loss"].append(score.mean_loss)
        except DivergedError:
            # Found at the end, when all is tested: what diverged is at chance.
            if not trials[0].choosing:
                raise
        return seconds, {name: torch.stack(x).view(len(x), n_trials, -1) for name, x in scores.items()}


_IN_CACHE = 40
"""Small networks that one CPU core trains fastest side by side: more of them no longer fit into its cache."""


def grouped(
    trials: Sequence[AccuracyTrial], passes: tuple[int, ...], *, networks: int | None = None
) -> list[SideBySide]:
    """Put trials together that can be fine-tuned as one program; the longest programs come first.

    A program has about as many replicas as ``networks`` says; None is what a CPU core or a GPU trains fastest.
    """
    groups = defaultdict(list)
    for trial in trials:
        groups[trial.fine_tuning].append(trial)
    programs = []
    for alike in groups.values():
        data = finetuning_of(plan_of(alike[0], passes[-1]))[0].data
        n_replicas = math.prod(data.replicas)
        on_cpu = device_of(alike[0].settings["trainer"]["accelerator"]).type == "cpu"
        usual = _IN_CACHE if on_cpu else 10_000
        at_once = usual if networks is None else networks
        require_count("figure.networks", at_once)
        each = len(data.train_batches(0, 1)) * n_replicas * passes[-1]
        most = max(1, at_once // n_replicas)
        # Programs of about one size: replicas are what counts.
        size = math.ceil(len(alike) / math.ceil(len(alike) / most))
        for start in range(0, len(alike), size):
            some = tuple(alike[start : start + size])
            programs.append(SideBySide(some, passes, each * len(some)))
    # So that no process is left alone with a long one at the end.
    return sorted(programs, key=lambda program: -program.n_updates)


def plan_of(trial: AccuracyTrial, n_passes: int) -> Plan:
    """The stages of a trial, as the command line would build them for it alone."""
    settings = dict(trial.settings)
    settings["seed"] = trial.seed
    settings["pretrain"] = {**settings["pretrain"], "iterations": trial.iterations}
    settings["finetune"] = {**settings["finetune"], "iterations": n_passes}
    return trial.build(settings)


def pretrained(plan: Plan, seed: int, device: torch.device) -> Plan:
    """Train the DBN of a plan, and change it as the control says."""
    plan.network.to(device)
    if plan.pretraining is not None:
        stage, module = pretraining_of(plan)
        for _ in passes_without_trainer(module, stage.data.train_batches(0, 1).to(device), seed=seed):
            pass
    plan.change_between_stages(seed)
    return plan


def _side_by_side(
    v: Tensor, label: Tensor, n_trials: int, replicas: tuple[int, ...], device: torch.device
) -> Batch:
    """Images for all trials; what all replicas share is not copied."""
    v, label = v.to(device), label.to(device)
    if label.ndim == 1:
        n_networks = n_trials * math.prod(replicas)
        return Batch(v.expand(n_networks, -1, -1), label.expand(n_networks, -1), 1.0, True)
    return Batch(v.repeat(n_trials, 1, 1), label.repeat(n_trials, 1), 1.0, True)


def device_of(accelerator: str) -> torch.device:
    """Where networks train, from the trainer's setting."""
    use_gpu = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
    return torch.device("cuda" if use_gpu else "cpu")
