"""A figure of the paper: many networks, trained side by side, a record for each as soon as it exists."""

import json
import math
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hydra import compose
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from tqdm import tqdm

from memcomp_lightning import rng
from memcomp_lightning.callbacks import MomentumSchedule
from memcomp_lightning.cli import build as stages
from memcomp_lightning.cli.build import Stage, build
from memcomp_lightning.errors import require_choice, require_count
from memcomp_lightning.files import write_text
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import Classifier, DBNPretraining, DivergedError, evaluate
from memcomp_lightning.replicas import Rates, finetune, pretrain, stacked
from memcomp_lightning.report import Plan, Record, Records
from memcomp_lightning.types import Batch

Progress = Callable[[str, int], None]
"""Takes what is being done, and how many network updates were done since the last call."""

CURVE_SETTINGS = ("label", "overrides", "iterations", "choose", "stop_early")


@dataclass(frozen=True)
class Unit:
    """Networks that train as one tensor program.

    Attributes:
        curve: Name of the curve.
        config: Settings of all of them, as plain values.
        members: Pretraining iterations and seed of each.
        passes: Fine-tuning passes after which they are tested.
        choice: Value of the setting that is being chosen, or has been.
        choosing: Whether this run is for the choice; it is judged on held-out training images.
        n_updates: Network updates, of all replicas.
    """

    curve: str
    config: dict[str, Any]
    members: tuple[tuple[int, int], ...]
    passes: tuple[int, ...]
    choice: float | None
    choosing: bool
    n_updates: int

    @property
    def title(self) -> str:
        """For people."""
        what = f"choosing, {self.choice:g}" if self.choosing else f"N = {self.members[0][0]}"
        return f"{self.curve}, {what}"


def train_curves(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Train what is missing for a figure; each record is written when it exists."""
    records = Records(folder)
    write_text(folder / "figure.json", json.dumps(_shown(config, overrides), indent=1) + "\n")
    with _runner(config) as run:
        for choosing in (True, False):
            units = plan_units(config, overrides, records, choosing=choosing)
            with tqdm(total=sum(unit.n_updates for unit in units), unit="update", unit_scale=True) as bar:
                bar.set_description(config.figure.name)

                def show(what: str, n_updates: int, bar: "tqdm[Any]" = bar) -> None:
                    bar.set_description(f"{config.figure.name}: {what}", refresh=False)
                    bar.update(n_updates)

                for found in run(units, show):
                    records.append(found)


def parts(config: DictConfig, overrides: Sequence[str]) -> dict[str, tuple[DictConfig, list[str]]]:
    """The figures of a run by their folders, each with its configuration and overrides."""
    if "all" not in config.figure:
        return {".": (config, list(overrides))}
    others = [o for o in overrides if o.partition("=")[0] != "experiment"]
    own = {name: [f"experiment={name}", *others] for name in config.figure.all}
    return {name: (compose("config", some), some) for name, some in own.items()}


def _shown(config: DictConfig, overrides: Sequence[str]) -> dict[str, Any]:
    """What the report needs to know of the settings: ``report.Plan``."""
    figure = OmegaConf.to_container(config.figure, resolve=True)
    assert isinstance(figure, dict)
    curves = figure["curves"]
    data = build(composed_for([*overrides, "pretrain.iterations=1", "finetune.iterations=1"])).stages[0].data
    compared = [name for name in figure["claim"] if name in curves]
    n_parts = math.prod(data.replicas)
    parts = f"{n_parts} of {config.data.partitions} partitions of {data.n_train:,} images" if data.replicas else ""
    seeds = f"{len(figure['seeds'])} seeds" if len(figure["seeds"]) > 1 else ""
    whole = f"all {data.n_train:,} training images" if not parts else ""
    return {
        "name": figure["name"],
        "title": figure["title"],
        "data": data.images.name,
        "against": figure["against"],
        "passes": sorted(figure["passes"]),
        "claim": figure["claim"],
        "labels": {name: curves[name]["label"] for name in dict.fromkeys((*compared, *curves))},
        "chosen": {name: curve["choose"]["setting"] for name, curve in curves.items() if "choose" in curve},
        "stop_early": [name for name, curve in curves.items() if curve.get("stop_early", False)],
        "scale": ", ".join(part for part in (whole, parts, seeds) if part),
    }


def check(config: DictConfig, overrides: Sequence[str]) -> None:
    """Build the networks of every curve, and train nothing.

    Raises:
        UserError, SettingError, InstantiationException: As ``build``.
    """
    Plan(**_shown(config, overrides))
    for name, curve in config.figure.curves.items():
        for key in curve:
            require_choice(f"setting of figure.curves.{name}", str(key), CURVE_SETTINGS)
        extra = [f"{curve.choose.setting}={curve.choose['values'][0]}"] if "choose" in curve else []
        build(composed_for([*overrides, *curve.overrides, *extra]))


def plan_units(config: DictConfig, overrides: Sequence[str], records: Records, *, choosing: bool) -> list[Unit]:
    """What is to be trained and has no record yet, the choices or the curves themselves.

    Raises:
        UserError, SettingError: A curve's settings are wrong, or its choice is not known yet.
    """
    units: list[Unit] = []
    for name, curve in config.figure.curves.items():
        values: list[float | None] = [None]
        if "choose" in curve:
            values = [*curve.choose["values"]] if choosing else [records.best_choice(name)]
        elif choosing:
            continue
        iterations = list(curve.get("iterations", config.figure.iterations))
        for value in values:
            extra = [] if value is None else [f"{curve.choose.setting}={value}"]
            if choosing:
                extra += ["data.validation_fraction=0.1"]
                iterations = iterations[-1:]
            composed = composed_for([*overrides, *curve.overrides, *extra])
            members = [
                (n, seed)
                for n in iterations
                for seed in (list(config.figure.seeds)[:1] if choosing else config.figure.seeds)
                if not records.has(name, value, choosing, n, seed)
            ]
            passes = tuple(sorted(config.figure.passes))
            if not members:
                continue
            each = _updates(composed, passes[-1])
            plain: Any = OmegaConf.to_container(composed, resolve=False)
            for some in _groups(members, _n_members(config, composed)):
                units.append(Unit(name, plain, some, passes, value, choosing, each * len(some)))
    # The longest first, so that no process is left alone with one at the end.
    return sorted(units, key=lambda unit: -unit.n_updates)


def composed_for(overrides: Sequence[str]) -> DictConfig:
    """The configuration of one curve, without the figure.

    Settings that the curve does not have are left out: ``solver.max_steps`` where its solver is descent.
    """
    own = [o for o in overrides if not o.lstrip("+~").startswith(("hydra.", "figure.", "figure/"))]
    bare = compose("config", [o for o in own if "." not in o.partition("=")[0]])
    composed = compose("config", [o for o in own if _applies(o.partition("=")[0], bare)])
    composed.figure = None
    return composed


def _applies(name: str, config: DictConfig) -> bool:
    if "." not in name or name.startswith("+"):
        return True
    parent, _, key = name.rpartition(".")
    node = OmegaConf.select(config, parent)
    return isinstance(node, DictConfig) and key in node


def _n_members(config: DictConfig, composed: DictConfig) -> int:
    """How many members train as one program: replicas are what counts."""
    n_replicas: int = min(composed.data.partitions, composed.data.first_partitions or composed.data.partitions)
    networks = config.figure.networks
    if networks is None:
        networks = 10_000 if torch.cuda.is_available() else _IN_CACHE
    require_count("figure.networks", networks)
    return max(1, int(networks // n_replicas))


_IN_CACHE = 40
"""Small networks that one CPU core trains fastest side by side: fewer wait for Python, more leave the cache."""


def _groups(members: list[tuple[int, int]], size: int) -> Iterator[tuple[tuple[int, int], ...]]:
    for start in range(0, len(members), size):
        yield tuple(members[start : start + size])


def _updates(composed: DictConfig, n_passes: int) -> int:
    """Updates of all replicas of one network."""
    plan = build(composed)
    assert plan.finetuning is not None
    data = plan.finetuning.data
    return len(data.train_batches(0, 1)) * math.prod(data.replicas) * n_passes


def plan_of(unit: Unit, iterations: int, seed: int) -> stages.Plan:
    """The stages of one member, as the command line would build them for it alone."""
    config = OmegaConf.create(unit.config)
    config.pretrain.iterations, config.seed = iterations, seed
    config.finetune.iterations = unit.passes[-1]
    return build(config)


def run_unit(unit: Unit, progress: Progress) -> list[Record]:
    """Train the networks of a unit; a value that is only tried may diverge, and is then no choice.

    Raises:
        DivergedError: Naming the curve.
    """
    try:
        return _train_unit(unit, progress)
    except DivergedError as error:
        if not unit.choosing:
            raise DivergedError(f"figure.curves.{unit.curve}: {error}") from error
        nothing = {name: [[0.0]] * len(unit.passes) for name in ("validation_accuracy", "test_accuracy")}
        return [_record(unit, n, seed, nothing, 0.0, 0.0) for n, seed in unit.members]


def _record(
    unit: Unit, n: int, seed: int, scores: dict[str, list[list[float]]], pretrain_s: float, finetune_s: float
) -> Record:
    return Record(
        curve=unit.curve,
        choice=unit.choice,
        choosing=unit.choosing,
        iterations=n,
        seed=seed,
        passes=list(unit.passes),
        scores=scores,
        pretrain_s=pretrain_s,
        finetune_s=finetune_s,
    )


def _train_unit(unit: Unit, progress: Progress) -> list[Record]:
    """Pretrain each member, fine-tune all of them side by side, test after the passes asked for."""
    begin = time.perf_counter()
    device = _device(unit.config["trainer"]["accelerator"])
    plans = []
    for number, (n, seed) in enumerate(unit.members):
        progress(f"{unit.title}, pretraining {number + 1} of {len(unit.members)}", 0)
        plans.append(pretrained(plan_of(unit, n, seed), seed, device))
    middle = time.perf_counter()
    stage = _tuning(plans[0])
    n_members, replicas = len(plans), stage.data.replicas
    network = stacked([_classifier(plan).network for plan in plans], replicas).to(device)
    batches = stage.data.train_batches(0, 1).repeated([seed for _, seed in unit.members]).to(device)
    tests = {"test": stage.data.test, "validation": stage.data.validation}
    images = {name: _side_by_side(*held, n_members, replicas, device) for name, held in tests.items() if held}
    scores: dict[str, list[Tensor]] = {f"{name}_{what}": [] for name in images for what in ("accuracy", "loss")}
    n_updates = len(batches) * n_members * math.prod(replicas)
    for done in finetune(network, batches, iterations=unit.passes[-1], rates=rates_of(stage)):
        progress(f"{unit.title}, pass {done} of {unit.passes[-1]}", n_updates)
        if done in unit.passes:
            for name, batch in images.items():
                score = evaluate(network, [batch])
                scores[f"{name}_accuracy"].append(score.accuracy)
                scores[f"{name}_loss"].append(score.mean_loss)
    end = time.perf_counter()
    # (n_passes, n_members, n_replicas)
    values = {name: torch.stack(x).view(len(x), n_members, -1).tolist() for name, x in scores.items()}
    found = []
    for member, (n, seed) in enumerate(unit.members):
        own = {name: [of_pass[member] for of_pass in x] for name, x in values.items()}
        found.append(_record(unit, n, seed, own, (middle - begin) / n_members, (end - middle) / n_members))
    return found


def pretrained(plan: stages.Plan, seed: int, device: torch.device) -> stages.Plan:
    """Train the DBN of a plan, and change it as the control says."""
    network = plan.network.to(device)
    if plan.pretraining is not None:
        stage = plan.pretraining
        module = stage.module
        assert isinstance(module, DBNPretraining)
        pretrain(
            module.dbn,
            stage.data.train_batches(0, 1).to(device),
            module.sampler,
            iterations=module.iterations,
            rates=rates_of(stage),
            seed=seed,
        )
    if plan.between is not None and isinstance(network, DBN):
        plan.between(network, generator=rng.stream(seed, "between stages"))
    return plan


def rates_of(stage: Stage) -> Rates:
    """Optimiser and momentum of a stage."""
    schedules = [callback for callback in stage.callbacks if isinstance(callback, MomentumSchedule)]
    return Rates(stage.module.make_optimizer, schedules[0].momentum if schedules else None)


def _tuning(plan: stages.Plan) -> Stage:
    assert plan.finetuning is not None
    return plan.finetuning


def _classifier(plan: stages.Plan) -> Classifier:
    module = _tuning(plan).module
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


def _device(accelerator: str) -> torch.device:
    use_gpu = accelerator in ("auto", "gpu", "cuda") and torch.cuda.is_available()
    return torch.device("cuda" if use_gpu else "cpu")


def _n_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


Runner = Callable[[Sequence[Unit], Progress], Iterator[list[Record]]]


@contextmanager
def _runner(config: DictConfig) -> Iterator[Runner]:
    """What trains units: this process, or as many others as there are cores, each on one thread."""
    workers = config.figure.workers
    if workers is None:
        workers = 1 if _device(config.trainer.accelerator).type != "cpu" else _n_cores()
    require_count("figure.workers", workers)
    if workers == 1:
        yield _run_here
        return
    context = multiprocessing.get_context("spawn")
    messages = context.SimpleQueue()
    pool = ProcessPoolExecutor(workers, context, initializer=_begin_worker, initargs=(messages,))
    try:
        yield partial(_run_in_pool, pool, messages)
    except BaseException:
        for process in list(pool._processes.values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _run_here(units: Sequence[Unit], progress: Progress) -> Iterator[list[Record]]:
    for unit in units:
        yield run_unit(unit, progress)


def _run_in_pool(
    pool: ProcessPoolExecutor, messages: Any, units: Sequence[Unit], progress: Progress
) -> Iterator[list[Record]]:
    running = {pool.submit(_run_in_worker, unit) for unit in units}
    while running:
        done, running = wait(running, timeout=0.2, return_when=FIRST_COMPLETED)
        while not messages.empty():
            progress(*messages.get())
        for future in done:
            yield future.result()


_messages: Any = None
"""Where a worker process says what it is doing."""


def _begin_worker(messages: Any) -> None:
    global _messages
    _messages = messages
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process ends the others
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)


def _end_with_parent() -> None:
    """A first process that is killed cannot end the others."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _run_in_worker(unit: Unit) -> list[Record]:
    last, waiting = time.monotonic(), 0

    def report(what: str, n_updates: int) -> None:
        nonlocal last, waiting
        waiting += n_updates
        if time.monotonic() - last > 0.2:
            _messages.put((what, waiting))
            last, waiting = time.monotonic(), 0

    records = run_unit(unit, report)
    _messages.put((unit.title, waiting))
    return records
