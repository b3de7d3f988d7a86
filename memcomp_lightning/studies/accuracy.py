"""Trials that are measured by accuracy: networks of a figure, and their training side by side."""

import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from memcomp_lightning.errors import require_count
from memcomp_lightning.models import stacked
from memcomp_lightning.modules import Classifier, EnergyPretraining
from memcomp_lightning.studies.plan import Plan, Stage
from memcomp_lightning.studies.records import Record
from memcomp_lightning.training import DivergedError, evaluate, finetune, pretrain
from memcomp_lightning.types import Batch

Progress = Callable[[str, int], None]
"""Takes what is being done, and how many network updates were done since the last call."""


@dataclass(frozen=True)
class Member:
    """A network of a curve, with its replicas.

    Attributes:
        curve: Name of the curve.
        settings: Of the run, as plain values.
        build: Makes the objects of a run from its settings; a function of a module, which processes can import.
        iterations: Of pretraining.
        seed: Of weights, chains and order.
        choice: Value of the setting that is being chosen, or has been.
        choosing: Whether it is trained for the choice; it is judged on held-out training images.
    """

    curve: str
    settings: dict[str, Any]
    build: Callable[[dict[str, Any]], Plan]
    iterations: int
    seed: int
    choice: float | None
    choosing: bool

    @property
    def fine_tuning(self) -> str:
        """What networks must share to be fine-tuned as one program."""
        settings = self.settings
        shared = {name: settings[name] for name in ("data", "finetune", "trainer")}
        shared["network"] = [settings["model"]["_target_"], settings["model"]["hidden_sizes"]]
        return json.dumps(shared, sort_keys=True)


@dataclass(frozen=True)
class Unit:
    """Networks that are fine-tuned as one tensor program.

    Attributes:
        members: The networks; what :attr:`Member.fine_tuning` says is the same for all.
        passes: Fine-tuning passes after which they are tested.
        n_updates: Network updates, of all replicas.
    """

    members: tuple[Member, ...]
    passes: tuple[int, ...]
    n_updates: int

    @property
    def title(self) -> str:
        """For people."""
        first, more = self.members[0], len(self.members) - 1
        what = f"choosing, {first.choice:g}" if first.choosing else f"N = {first.iterations}"
        return f"{first.curve}, {what}" + (f" and {more} more" if more else "")


_IN_CACHE = 40
"""Small networks that one CPU core trains fastest side by side: more of them no longer fit into its cache."""


def grouped(members: Sequence[Member], passes: tuple[int, ...], *, networks: int | None) -> list[Unit]:
    """Put members together that can be fine-tuned as one program; the longest programs come first.

    Args:
        members: Networks to train.
        passes: Fine-tuning passes after which they are tested.
        networks: Replicas in a program, about; None is what a CPU core or a GPU trains fastest.
    """
    groups: dict[str, list[Member]] = {}
    for member in members:
        groups.setdefault(member.fine_tuning, []).append(member)
    units = []
    for alike in groups.values():
        data = tuning(plan_of(alike[0], passes[-1])).data
        n_replicas = math.prod(data.replicas)
        each = len(data.train_batches(0, 1)) * n_replicas * passes[-1]
        size = _n_members(alike[0], len(alike), n_replicas, networks)
        for start in range(0, len(alike), size):
            some = tuple(alike[start : start + size])
            units.append(Unit(some, passes, each * len(some)))
    # So that no process is left alone with a long one at the end.
    return sorted(units, key=lambda unit: -unit.n_updates)


def _n_members(member: Member, n_all: int, n_replicas: int, networks: int | None) -> int:
    """How many members train as one program: replicas are what counts, in programs of about one size."""
    if networks is None:
        networks = 10_000 if device_of(member.settings["trainer"]["accelerator"]).type != "cpu" else _IN_CACHE
    require_count("figure.networks", networks)
    most = max(1, int(networks // n_replicas))
    return math.ceil(n_all / math.ceil(n_all / most))


def plan_of(member: Member, n_passes: int) -> Plan:
    """The stages of a member, as the command line would build them for it alone."""
    settings = dict(member.settings)
    settings["seed"] = member.seed
    settings["pretrain"] = {**settings["pretrain"], "iterations": member.iterations}
    settings["finetune"] = {**settings["finetune"], "iterations": n_passes}
    return member.build(settings)


def run_unit(unit: Unit, progress: Progress) -> list[Record]:
    """Pretrain each member, fine-tune all of them side by side, test after the passes asked for.

    A value that is only tried may diverge: it is then no choice.

    Raises:
        DivergedError: Naming the curve.
    """
    device = device_of(unit.members[0].settings["trainer"]["accelerator"])
    members, plans, pretrain_s, found = [], [], [], []
    for number, member in enumerate(unit.members):
        progress(f"{unit.title}, pretraining {number + 1} of {len(unit.members)}", 0)
        begin = time.perf_counter()
        try:
            plan = pretrained(plan_of(member, unit.passes[-1]), member.seed, device)
        except DivergedError as error:
            if not member.choosing:
                raise DivergedError(f"figure.curves.{member.curve}: {error}") from error
            nothing = {f"{name}_accuracy": [[0.0]] * len(unit.passes) for name in ("test", "validation")}
            found.append(_record(member, unit, nothing, time.perf_counter() - begin, 0.0))
            continue
        members.append(member)
        plans.append(plan)
        pretrain_s.append(time.perf_counter() - begin)
    if not members:
        return found
    begin = time.perf_counter()
    try:
        scores = _fine_tuned(plans, members, unit, progress, device)
    except DivergedError as error:
        curves = ", ".join(dict.fromkeys(member.curve for member in members))
        raise DivergedError(f"figure.curves.{curves}: {error}") from error
    finetune_s = (time.perf_counter() - begin) / len(members)
    for number, member in enumerate(members):
        own = {name: [of_pass[number] for of_pass in values] for name, values in scores.items()}
        found.append(_record(member, unit, own, pretrain_s[number], finetune_s))
    return found


def _fine_tuned(
    plans: Sequence[Plan], members: Sequence[Member], unit: Unit, progress: Progress, device: torch.device
) -> dict[str, list[list[list[float]]]]:
    """Scores by name, pass, member and replica."""
    stage = tuning(plans[0])
    n_members, replicas = len(plans), stage.data.replicas
    network, loss = stacked([_classifier(plan).network for plan in plans], replicas), _classifier(plans[0]).loss
    network.to(device)
    batches = stage.data.train_batches(0, 1).repeated([member.seed for member in members]).to(device)
    tests = {"test": stage.data.test, "validation": stage.data.validation}
    images = {name: _side_by_side(*held, n_members, replicas, device) for name, held in tests.items() if held}
    scores: dict[str, list[Tensor]] = {f"{name}_{what}": [] for name in images for what in ("accuracy", "loss")}
    n_updates = len(batches) * n_members * math.prod(replicas)
    # Where several passes are tested, the best of these is found by the report.
    keeps_best = members[0].settings["finetune"]["keep_best"] and len(unit.passes) == 1
    try:
        for done in finetune(
            network,
            batches,
            iterations=unit.passes[-1],
            optimizer=stage.module.make_optimizer,
            schedules=stage.module.schedules,
            loss=loss,
            keep_best_by=images["validation"] if keeps_best else None,
        ):
            progress(f"{unit.title}, pass {done} of {unit.passes[-1]}", n_updates)
            if done in unit.passes:
                for name, batch in images.items():
                    score = evaluate(network, [batch], loss)
                    scores[f"{name}_accuracy"].append(score.accuracy)
                    scores[f"{name}_loss"].append(score.mean_loss)
    except DivergedError:
        # Found at the end, when all is tested: what diverged is at chance.
        if not members[0].choosing:
            raise
    return {name: torch.stack(x).view(len(x), n_members, -1).tolist() for name, x in scores.items()}


def _record(
    member: Member, unit: Unit, scores: dict[str, list[list[float]]], pretrain_s: float, finetune_s: float
) -> Record:
    return Record(
        curve=member.curve,
        choice=member.choice,
        choosing=member.choosing,
        iterations=member.iterations,
        seed=member.seed,
        passes=list(unit.passes),
        scores=scores,
        pretrain_s=pretrain_s,
        finetune_s=finetune_s,
    )


def pretrained(plan: Plan, seed: int, device: torch.device) -> Plan:
    """Train the DBN of a plan, and change it as the control says."""
    plan.network.to(device)
    if plan.pretraining is not None:
        stage = plan.pretraining
        module, batches = stage.module, stage.data.train_batches(0, 1).to(device)
        assert isinstance(module, EnergyPretraining)
        passes = pretrain(
            module.pretraining,
            batches,
            module.sampler,
            iterations=module.iterations,
            optimizer=module.make_optimizer,
            schedules=module.schedules,
            centring=module.centring,
            seed=seed,
        )
        for _ in passes:
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
    v: Tensor, label: Tensor, n_members: int, replicas: tuple[int, ...], device: torch.device
) -> Batch:
    """Images for all members; what all replicas share is not copied."""
    v, label = v.to(device), label.to(device)
    if label.ndim == 1:
        n_networks = n_members * math.prod(replicas)
        return Batch(v.expand(n_networks, -1, -1), label.expand(n_networks, -1), 1.0, True)
    return Batch(v.repeat(n_members, 1, 1), label.repeat(n_members, 1), 1.0, True)


def device_of(accelerator: str) -> torch.device:
    """Where networks train, from the trainer's setting."""
    use_gpu = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
    return torch.device("cuda" if use_gpu else "cpu")
