"""What is timed: each piece of work on any device, in pieces that end soon."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import torch
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.data import Batches, ImageData, ImageDataModule, PixelLayout
from memcomp_lightning.likelihood import Ais
from memcomp_lightning.models import DBN, RBM, Normal
from memcomp_lightning.modules import DBNClassifier
from memcomp_lightning.problems import from_model
from memcomp_lightning.samplers import CD, PCD, NegativePhaseSampler, ParallelTempering
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.training import Greedy, PhaseTraining, finetune

Piece = Callable[[], int]
"""Does a piece of the work; returns how many units of it."""

KERNELS = {"cpu": "compiled", "cuda": "cuda"}
"""The DMM's kernel that is not the plain one, by the kind of device."""


@dataclass(frozen=True, kw_only=True)
class Size:
    """How large the work is; these are the sizes of the tables."""

    visible: int = 784
    hidden: int = 500
    wide: int = 4096
    rows: int = 6000
    few_rows: int = 2000
    batch: int = 100
    chains: int = 10_000
    ladders: int = 100
    temperatures: int = 10
    betas: int = 200
    replicas: int = 40
    small: int = 32
    problems: int = 500
    restarts: int = 28
    steps: int = 20
    slow_steps: int = 5


QUICK = Size(
    visible=48,
    hidden=24,
    wide=64,
    rows=300,
    few_rows=300,
    chains=200,
    ladders=10,
    temperatures=4,
    betas=20,
    replicas=2,
    small=8,
    problems=4,
    restarts=4,
    steps=8,
    slow_steps=3,
)
"""Does everything run? And what is waited for, which does not depend on the size."""


@dataclass(frozen=True, kw_only=True)
class Work:
    """One row of the table.

    Attributes:
        what: For the table.
        unit: What a piece is counted in.
        whole: So many units are what people wait for, and its name.
        start: From a device's name and the size to the first piece.
        beside: The row whose time on the CPU this one is held against, where it is not its own.
    """

    what: str
    unit: str
    whole: tuple[int, str]
    start: Callable[[str, Size], Piece]
    beside: str | None = None


def training(
    device: str,
    size: Size,
    sampler: Callable[[Size], NegativePhaseSampler],
    *,
    wide: bool = False,
    slow: bool = False,
    draws_on: str | None = None,
) -> Piece:
    """A pass over random images by the loop without a trainer.

    ``slow`` updates come in shorter passes. ``draws_on`` is the device of the random numbers: under Lightning's
    trainer they are the host's.
    """
    hidden, rows = size.wide if wide else size.hidden, size.few_rows if slow else size.rows
    dbn = DBN(size.visible, [hidden], weight_init=Normal(std=0.01)).to(device)
    batches = images(rows, size.visible, size.batch).to(device)
    streams = rng.streams(0, ("negative_phase", "positive_phase"), device=draws_on or device)
    phase = Greedy(dbn).phases[0]
    loop = PhaseTraining(phase, sampler(size), optimizer=partial(SGD, lr=0.01), centring=None, streams=streams)
    passes = iter(range(10**9))

    def piece() -> int:
        batches.set_epoch(next(passes))
        loop.run_pass(batches)
        return len(batches)

    return piece


def images(n: int, n_visible: int, batch: int, classes: int = 1) -> Batches:
    """Random binary images; what they show does not matter."""
    v = rng.bernoulli(torch.full((n, n_visible), 0.5), generator=rng.stream(0, "images"))
    label = torch.arange(n) % classes
    everything = ImageData(v, label, v[:classes], label[:classes], classes, PixelLayout(1, n_visible), "random")
    return ImageDataModule(everything, batch_size=batch).train_batches(0, 1)


def figure(device: str, size: Size) -> Piece:
    """A pass of fine-tuning of a stack of the networks of Fig. 4, in which most of its time goes."""
    layers = [size.small, size.small]
    dbn = DBN(size.small, layers, replicas=(size.replicas,), weight_init=Normal(std=0.1))
    network = DBNClassifier(dbn).network.to(device)
    batches = images(size.rows, size.small, size.batch, classes=10).repeated([0] * size.replicas).to(device)
    passes: Iterator[int] = finetune(network, batches, iterations=10**9, optimizer=partial(SGD, lr=0.1))

    def piece() -> int:
        next(passes)
        return len(batches) * size.replicas

    return piece


def annealing(device: str, size: Size) -> Piece:
    """AIS with 100 chains, a few temperatures."""
    rbm = random_rbm(size.visible, size.hidden, 0.05).to(device)
    generator, ais = rng.stream(0, "annealing", device=device), Ais(n_betas=size.betas)

    def piece() -> int:
        ais.estimate(rbm, generator=generator)
        return size.betas

    return piece


def machine(device: str, size: Size, *, many: bool, plain: bool) -> Piece:
    """Steps of the DMM, with a descent from the bits at each of them, as is the default for two layers."""
    kernel = "reference" if plain else KERNELS[torch.device(device).type]
    shape = (size.small, size.small, (size.problems,)) if many else (size.visible, size.hidden, ())
    problem = from_model(random_rbm(*shape[:2], 0.5, replicas=shape[2]).to(device))
    n_steps = size.slow_steps if plain and device == "cpu" else size.steps
    solver = DmmSolver(n_restarts=size.restarts, max_steps=n_steps, stall=None, kernel=kernel)
    generator = rng.stream(0, "solver", device=device)

    def piece() -> int:
        solver.minimise(problem, generator=generator)
        return n_steps

    return piece


def random_rbm(n_visible: int, n_hidden: int, std: float, replicas: tuple[int, ...] = ()) -> RBM:
    init, generator = Normal(std=std), rng.stream(0, "weights")
    return RBM(n_visible, n_hidden, replicas=replicas, weight_init=init, generator=generator)


def cd(size: Size) -> NegativePhaseSampler:
    return CD(k=1)


def pcd(size: Size) -> NegativePhaseSampler:
    return PCD(k=1, n_chains=size.chains)


def tempering(size: Size) -> NegativePhaseSampler:
    return ParallelTempering(n_chains=size.ladders, n_temperatures=size.temperatures)


EPOCH, UPDATE = (600, "an epoch of 60,000 rows"), "update of 100 rows"
SOLVE_MANY, SOLVE_LARGE = (192, "192 steps, the default"), (955, "955 steps, the default")
FIGURE_4 = (24_000_000, "fine-tuning of all networks of Fig. 4")
MANY, LARGE = "DMM, 500 problems of 32x32, 28 restarts", "DMM, one problem of 784x500, 28 restarts"

WORKS = {
    "cd": Work(what="CD-1, 784x500", unit=UPDATE, whole=EPOCH, start=partial(training, sampler=cd)),
    "cd_wide": Work(
        what="CD-1, 784x4096", unit=UPDATE, whole=EPOCH, start=partial(training, sampler=cd, wide=True, slow=True)
    ),
    "cd_host_draws": Work(
        what="CD-1, 784x500, random numbers from the host, as under Lightning",
        unit=UPDATE,
        whole=EPOCH,
        start=partial(training, sampler=cd, draws_on="cpu"),
        beside="cd",
    ),
    "pcd": Work(
        what="PCD-1, 784x500, 10,000 chains",
        unit=UPDATE,
        whole=EPOCH,
        start=partial(training, sampler=pcd, slow=True),
    ),
    "pcd_host_draws": Work(
        what="PCD-1, 784x500, 10,000 chains, random numbers from the host, as under Lightning",
        unit=UPDATE,
        whole=EPOCH,
        start=partial(training, sampler=pcd, slow=True, draws_on="cpu"),
        beside="pcd",
    ),
    "pt": Work(
        what="parallel tempering, 784x500, 100 ladders of 10 temperatures",
        unit=UPDATE,
        whole=EPOCH,
        start=partial(training, sampler=tempering),
    ),
    "ais": Work(
        what="AIS, 784x500, 100 chains", unit="temperature", whole=(1000, "1,000 temperatures"), start=annealing
    ),
    "figure4": Work(
        what="Fig. 4, stacks of 40 networks", unit="update of one network", whole=FIGURE_4, start=figure
    ),
    "dmm_many": Work(
        what=f"{MANY}, plain kernel", unit="step", whole=SOLVE_MANY, start=partial(machine, many=True, plain=True)
    ),
    "dmm_many_kernel": Work(
        what=f"{MANY}, compiled kernel",
        unit="step",
        whole=SOLVE_MANY,
        start=partial(machine, many=True, plain=False),
    ),
    "dmm_large": Work(
        what=f"{LARGE}, plain kernel",
        unit="step",
        whole=SOLVE_LARGE,
        start=partial(machine, many=False, plain=True),
    ),
    "dmm_large_kernel": Work(
        what=f"{LARGE}, compiled kernel",
        unit="step",
        whole=SOLVE_LARGE,
        start=partial(machine, many=False, plain=False),
    ),
}
"""By the names of the command line, in the order of the table."""
