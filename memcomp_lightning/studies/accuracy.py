"""Trials that are measured by accuracy, as those of figures, and their training side by side."""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning.errors import require_count
from memcomp_lightning.models import stacked
from memcomp_lightning.modules import Classifier, EnergyPretraining
from memcomp_lightning.studies.plan import Plan, Stage, passes_without_trainer
from memcomp_lightning.studies.records import Key, Record
from memcomp_lightning.training import DivergedError, evaluate, finetune
from memcomp_lightning.types import Batch

Progress = Callable[[str, int], None]
"""Takes what is being done, and how many network updates were done since the last call."""


@dataclass(frozen=True)
class AccuracyTrial:
    """A network, with its replicas, that is pretrained, fine-tuned and tested.

    Attributes:
        method: Name of its curve.
        settings: Of the run, as plain values.
        build: Makes the objects of a run from its settings; a function of a module, which processes can import.
        iterations: Of pretraining.
        seed: Of weights, chains and order.
        value: Of the setting that held-out images choose; None where nothing is chosen.
        choosing: Whether the trial only serves the choice: held-out training images then judge it.
    """

    method: str
    settings: dict[str, Any]
    build: Callable[[dict[str, Any]], Plan]
    iterations: int
    seed: int
    value: float | None
    choosing: bool

    @property
    def key(self) -> Key:
        """Of the record that it leaves."""
        return "", self.method, self.value, self.iterations, self.seed, self.choosing

    @property
    def fine_tuning(self) -> str:
        """What networks must share to be fine-tuned as one program."""
        settings = self.settings
        shared = {name: settings[name] for name in ("data", "finetune", "trainer")}
        shared["network"] = [settings["model"]["_target_"], settings["model"]["hidden_sizes"]]
        return json.dumps(shared, sort_keys=True)

    def record(self, passes: Sequence[int], seconds: list[float], scores: dict[str, list[list[float]]]) -> Record:
        """What it leaves; held-out images judge by the mean over tested passes and replicas."""
        judged = float(np.mean(scores["validation_accuracy"])) if self.choosing else None
        return Record(
            method=self.method,
            value=self.value,
            iterations=self.iterations,
            seed=self.seed,
            choosing=self.choosing,
            at=list(passes),
            seconds=seconds,
            measures=scores,
            held_out=judged,
        )


@dataclass(frozen=True)
class SideBySide:
    """Trials whose networks are fine-tuned as one tensor program.

    Attributes:
        trials: What :attr:`AccuracyTrial.fine_tuning` says is the same for all.
        passes: Fine-tuning passes after which they are tested.
        n_updates: Network updates, of all replicas.
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

        A value that is only tried may diverge: it is then no choice.

        Raises:
            DivergedError: Naming the curve.
        """
        device = device_of(self.trials[0].settings["trainer"]["accelerator"])
        trials, plans, pretrain_s, found = [], [], [], []
        for number, trial in enumerate(self.trials):
            progress(f"{self.title}, pretraining {number + 1} of {len(self.trials)}", 0)
            begin = time.perf_counter()
            try:
                plan = pretrained(plan_of(trial, self.passes[-1]), trial.seed, device)
            except DivergedError as error:
                if not trial.choosing:
                    raise DivergedError(f"figure.curves.{trial.method}: {error}") from error
                nothing = {f"{name}_accuracy": [[0.0]] * len(self.passes) for name in ("test", "validation")}
                found.append(trial.record(self.passes, [time.perf_counter() - begin] * len(self.passes), nothing))
                continue
            trials.append(trial)
            plans.append(plan)
            pretrain_s.append(time.perf_counter() - begin)
        if not trials:
            return found
        try:
            seconds, scores = self._fine_tuned(plans, trials, progress, device)
        except DivergedError as error:
            curves = ", ".join(dict.fromkeys(trial.method for trial in trials))
            raise DivergedError(f"figure.curves.{curves}: {error}") from error
        for number, trial in enumerate(trials):
            own = {name: [of_pass[number] for of_pass in values] for name, values in scores.items()}
            until = [pretrain_s[number] + each / len(trials) for each in seconds]
            found.append(trial.record(self.passes, until, own))
        return found

    def _fine_tuned(
        self, plans: Sequence[Plan], trials: Sequence[AccuracyTrial], progress: Progress, device: torch.device
    ) -> tuple[list[float], dict[str, list[list[list[float]]]]]:
        """Seconds by pass; scores by name, pass, trial and replica."""
        begin = time.perf_counter()
        stage = tuning(plans[0])
        n_trials, replicas = len(plans), stage.data.replicas
        network, loss = (
            stacked([_classifier(plan).network for plan in plans], replicas),
            _classifier(plans[0]).loss,
        )
        network.to(device)
        batches = stage.data.train_batches(0, 1).repeated([trial.seed for trial in trials]).to(device)
        tests = {"test": stage.data.test, "validation": stage.data.validation}
        images = {name: _side_by_side(*held, n_trials, replicas, device) for name, held in tests.items() if held}
        scores: dict[str, list[Tensor]] = {
            f"{name}_{what}": [] for name in images for what in ("accuracy", "loss")
        }
        seconds = []
        n_updates = len(batches) * n_trials * math.prod(replicas)
        # Where several passes are tested, the best of these is found by the report.
        keeps_best = trials[0].settings["finetune"]["keep_best"] and len(self.passes) == 1
        try:
            for done in finetune(
                network,
                batches,
                iterations=self.passes[-1],
                optimizer=stage.module.make_optimizer,
                schedules=stage.module.schedules,
                loss=loss,
                keep_best_by=images["validation"] if keeps_best else None,
            ):
                progress(f"{self.title}, pass {done} of {self.passes[-1]}", n_updates)
                if done in self.passes:
                    seconds.append(time.perf_counter() - begin)
                    for name, batch in images.items():
                        score = evaluate(network, [batch], loss)
                        scores[f"{name}_accuracy"].append(score.accuracy)
                        scores[f"{name}_loss"].append(score.mean_loss)
        except DivergedError:
            # Found at the end, when all is tested: what diverged is at chance.
            if not trials[0].choosing:
                raise
        return seconds, {name: torch.stack(x).view(len(x), n_trials, -1).tolist() for name, x in scores.items()}


_IN_CACHE = 40
"""Small networks that one CPU core trains fastest side by side: more of them no longer fit into its cache."""


def grouped(
    trials: Sequence[AccuracyTrial], passes: tuple[int, ...], *, networks: int | None = None
) -> list[SideBySide]:
    """Put trials together that can be fine-tuned as one program; the longest programs come first.

    Args:
        trials: Networks to train.
        passes: Fine-tuning passes after which they are tested.
        networks: Replicas in a program, about; None is what a CPU core or a GPU trains fastest.
    """
    groups: dict[str, list[AccuracyTrial]] = {}
    for trial in trials:
        groups.setdefault(trial.fine_tuning, []).append(trial)
    programs = []
    for alike in groups.values():
        data = tuning(plan_of(alike[0], passes[-1])).data
        n_replicas = math.prod(data.replicas)
        each = len(data.train_batches(0, 1)) * n_replicas * passes[-1]
        size = _n_trials(alike[0], len(alike), n_replicas, networks)
        for start in range(0, len(alike), size):
            some = tuple(alike[start : start + size])
            programs.append(SideBySide(some, passes, each * len(some)))
    # So that no process is left alone with a long one at the end.
    return sorted(programs, key=lambda program: -program.n_updates)


def _n_trials(trial: AccuracyTrial, n_all: int, n_replicas: int, networks: int | None) -> int:
    """How many trials train as one program: replicas are what counts, in programs of about one size."""
    if networks is None:
        networks = 10_000 if device_of(trial.settings["trainer"]["accelerator"]).type != "cpu" else _IN_CACHE
    require_count("figure.networks", networks)
    most = max(1, int(networks // n_replicas))
    return math.ceil(n_all / math.ceil(n_all / most))


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
        stage = plan.pretraining
        module, batches = stage.module, stage.data.train_batches(0, 1).to(device)
        assert isinstance(module, EnergyPretraining)
        for _ in passes_without_trainer(module, batches, seed=seed):
            pass
    plan.change_between_stages(seed)
    return plan


def tuning(plan: Plan) -> Stage:
    """The last stage, which every network of a figure has."""
    assert plan.finetuning is not None
    return plan.finetuning


def _classifier(plan: Plan) -> Classifier:
    module = tuning(plan).module
    assert isinstance(module, Classifier)
    return module


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
