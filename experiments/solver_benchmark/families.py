"""Which instances belong to which family. Tuning and reporting never share a random stream, hence no instance."""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

from instances import Instance, beasley, from_file, random_graph, random_max_sat, random_rbm, torus
from planted import frustrated_loops
from trained import Training

from memcomp_lightning import rng
from memcomp_lightning.problems import Qubo, WeightedMaxSat, from_model

SEED = 2020
Purpose = Literal["tuning", "report"]


class Made(NamedTuple):
    """What a maker returns: the problem, its lowest known energy and how it is known."""

    problem: Qubo | WeightedMaxSat
    best_known: float | None = None
    how: str = "best of all runs"
    name: str | None = None


@dataclass(frozen=True, kw_only=True, slots=True)
class Family:
    """Instances of one kind and size.

    Attributes:
        group: Kind without size.
        size: As text, "32x32".
        n: Number of variables.
        make: From the purpose and an index.
        n_tuning: Instances to tune on; 0 takes the settings of the group's nearest tuned sizes.
        n_report: Instances to report on.
        horizon: Seconds at which gaps are compared; None where the time to solution can be told.
    """

    group: str
    size: str
    n: int
    make: Callable[[Purpose, int], Made]
    n_tuning: int = 2
    n_report: int = 4
    horizon: float | None = None

    @property
    def name(self) -> str:
        """Kind and size."""
        return ", ".join(part for part in (self.group, self.size) if part)

    def instances(self, purpose: Purpose, limit: int | None = None) -> Iterator[Instance]:
        """The instances of one purpose, at most ``limit``."""
        count = self.n_tuning if purpose == "tuning" else self.n_report
        for index in range(count if limit is None else min(count, limit)):
            made = self.make(purpose, index)
            name = made.name or f"{self.name} {purpose} {index}"
            yield Instance(
                family=self.name, name=name, problem=made.problem, best_known=made.best_known, how=made.how
            )


def _drawn(name: str, draw: Callable[..., Qubo | WeightedMaxSat]) -> Callable[[Purpose, int], Made]:
    """Instances of a generator, each from a stream of its own."""
    return lambda purpose, index: Made(draw(generator=rng.stream(SEED, f"{purpose} {name}", index)))


FIELDS = {  # share of the mean field that the biases cancel, std of the biases beyond that
    "plain": (0.0, 0.5),
    "half-cancelled": (0.5, 0.5),
    "mean-cancelled": (1.0, 0.0),
    "mean-cancelled with biases": (1.0, 0.5),
}


def _random(kind: str, n_visible: int, n_hidden: int, std: float = 1.0, **counts: float) -> Family:
    cancelled, bias_std = FIELDS[kind]
    group, size = f"{kind}, std {std:g}", f"{n_visible}x{n_hidden}"
    draw = partial(random_rbm, n_visible, n_hidden, std, cancelled=cancelled, bias_std=bias_std)
    return Family(group=group, size=size, n=n_visible + n_hidden, make=_drawn(f"{group} {size}", draw), **counts)


def _trained(training: Training, cache: Path, **counts: float) -> Family:
    def make(purpose: Purpose, index: int) -> Made:
        return Made(from_model(training.rbm(seed=SEED, purpose=purpose, index=index, cache_folder=cache)))

    size, n = ("784x500", 1284) if training.full_size else ("32x32", 64)
    data = "MNIST" if training.full_size or os.environ.get("MEMCOMP_DATA_DIR") else "digits (no MNIST here)"
    return Family(group=f"trained on {data}, {training.label}", size=size, n=n, make=make, **counts)


def _planted(n: int, **counts: float) -> Family:
    def make(purpose: Purpose, index: int) -> Made:
        generator = rng.stream(SEED, f"{purpose} planted {n}", index)
        problem, _, energy = frustrated_loops(n, n, generator=generator)
        return Made(problem, energy, "planted")

    return Family(group="planted loops", size=f"{n}x{n}", n=2 * n, make=make, **counts)


def _max_sat(length: int, n: int, ratio: float) -> Family:
    group, size = f"random weighted MAX-{length}-SAT, ratio {ratio:g}", f"n={n}"
    draw = partial(random_max_sat, n, round(ratio * n), length)
    return Family(group=group, size=size, n=n, make=_drawn(f"{group} {size}", draw))


CUTS = {"G1": 11624, "G14": 3064, "G22": 13359, "G32": 1410, "G43": 6660, "G55": 10299}
MINIMA = {"bqp50-1": -2098, "bqp100-1": -7970, "bqp250-1": -45607, "bqp500-1": -116586, "bqp1000-2": -354932}
LOOKALIKES = {  # to tune on, never reported
    "G-set": (
        partial(random_graph, 800, 0.06, signs=False),
        partial(random_graph, 2000, 0.01, signs=False),
        partial(torus, 30),
    ),
    "Beasley": (partial(beasley, 250), partial(beasley, 500)),
}


def _files(group: str, horizon: float) -> Family:
    folder = Path(os.environ.get("MEMCOMP_DATA_DIR", "")) / "qubo"
    names = list(CUTS if group == "G-set" else MINIMA)

    def make(purpose: Purpose, index: int) -> Made:
        if purpose == "tuning":
            return Made(LOOKALIKES[group][index](generator=rng.stream(SEED, f"tuning {group}", index)))
        name = names[index]
        if group == "G-set":
            return Made(from_file(folder / f"{name}.txt"), -float(CUTS[name]), "published", name)
        problem = from_file(folder / f"{name}.sparse", maximise=name == "bqp1000-2")
        return Made(problem, float(MINIMA[name]), "published", name)

    n_report = len(names) if folder.is_dir() else 0
    return Family(
        group=group, size="", n=0, make=make, n_tuning=len(LOOKALIKES[group]), n_report=n_report, horizon=horizon
    )


def families(cache: Path) -> list[Family]:
    """All families; those that need files of ``MEMCOMP_DATA_DIR`` are left out where it is not set.

    Args:
        cache: Folder of trained weights.
    """
    medium = {"n_images": 6000, "batch_size": 100}
    trainings = [
        Training(sampler="CD-1", n_updates=3600, **medium),
        Training(sampler="CD-1", n_updates=3000, learning_rate=0.05),
        Training(sampler="PCD-1", n_updates=3600, **medium),
        Training(sampler="PCD-1", n_updates=18_000, learning_rate=0.03, **medium),
        Training(sampler="DMM", n_updates=600, **medium),
    ]
    large = {"full_size": True, "n_images": 60_000, "batch_size": 100, "learning_rate": 0.05}
    large_trainings = [
        Training(sampler="CD-1", n_updates=400, **large),
        Training(sampler="PCD-1", n_updates=400, **large),
        Training(sampler="DMM short", n_updates=30, **large),
    ]
    at_horizon = {"n_tuning": 1, "n_report": 4, "horizon": 0.2}
    chosen = [
        *(_random("plain", 32, 32, std) for std in (0.1, 0.5, 1.0)),
        *(_random("plain", *size) for size in ((100, 100), (250, 200))),
        _random("plain", 150, 100, n_tuning=0),
        *(_random("mean-cancelled", *size) for size in ((32, 32), (100, 100), (250, 200))),
        _random("mean-cancelled", 64, 64, n_tuning=0),
        *(_random("mean-cancelled with biases", *size) for size in ((32, 32), (100, 100))),
        *(_random("half-cancelled", *size) for size in ((100, 100), (250, 200))),
        *(_random("plain", 784, 500, std, **at_horizon | {"horizon": 0.1}) for std in (0.1, 0.5, 1.0)),
        _random("mean-cancelled", 784, 500, **at_horizon),
        *(_trained(training, cache) for training in trainings),
        *(_planted(n) for n in (60, 120, 200)),
        *(_planted(n, n_tuning=0) for n in (40, 90, 160, 300, 500)),
        *(_max_sat(*settings) for settings in ((2, 100, 4.0), (2, 200, 4.0), (3, 100, 6.0), (3, 200, 6.0))),
    ]
    if os.environ.get("MEMCOMP_DATA_DIR"):
        chosen += [_trained(training, cache, **at_horizon) for training in large_trainings]
        chosen += [_files("G-set", 1.0), _files("Beasley", 1.0)]
    groups = list(dict.fromkeys(family.group for family in chosen))
    return sorted(chosen, key=lambda family: (groups.index(family.group), family.n))
