"""Solvers that run all reads side by side: descent, block-Gibbs annealing, simulated bifurcation, the DMM."""

import functools
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
import simulated_bifurcation
import torch
from dwave.samplers import SteepestDescentSampler
from opponents import Opponent, Problem, Reads, SimulatedAnnealing, Tabu, answer, energies, model
from simulated_bifurcation.core import Ising
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.problems import Bipartite, Qubo, as_qubo
from memcomp_lightning.solvers import AlternatingDescent
from memcomp_lightning.solvers.dmm import BondField, ClauseField, DmmSolver, VectorField


def in_parts(problem: Problem, part: Callable[[int], tuple[Tensor, float]], n_reads: int, size: int) -> Reads:
    """Reads in groups of ``size``, each group side by side."""
    found, seconds = [], 0.0
    for start in range(0, n_reads, size):
        x, elapsed = part(min(size, n_reads - start))
        seconds += elapsed
        found.append(energies(problem, x))
    return Reads(np.concatenate(found), seconds)


@dataclass(frozen=True, kw_only=True, slots=True)
class Descent:
    """Descent from random starts; budget: sweeps after which a start is given up.

    Layer by layer in an RBM; elsewhere dwave-samplers' steepest descent, whose time is that of the call.
    """

    name: ClassVar[str] = "descent"
    budgets: ClassVar[tuple[int, ...]] = (100,)
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = ({},)

    def run(self, problem: Problem, *, n_reads: int, budget: int, seed: int) -> Reads:
        qubo = as_qubo(problem)
        if not isinstance(qubo.graph, Bipartite):
            bqm, _, build = model(problem)
            begin = time.perf_counter()
            samples = SteepestDescentSampler().sample(bqm, num_reads=n_reads, seed=seed)
            return answer(problem, samples, time.perf_counter() - begin, build)
        generator = rng.stream(seed, "descent")

        def part(n: int) -> tuple[Tensor, float]:
            solution = AlternatingDescent(n_restarts=n, max_sweeps=budget).minimise(qubo, generator=generator)
            return solution.assignments, solution.wall_time_s

        return in_parts(problem, part, n_reads, 1000)


@dataclass(frozen=True, kw_only=True, slots=True)
class GibbsAnnealing:
    """Block Gibbs sampling with rising inverse temperature, all reads side by side; budget: sweeps.

    An RBM's layers are drawn as matrix products, and three sweeps at zero temperature close. Other graphs
    have no blocks worth the name: there it is dwave-samplers' annealing with Gibbs acceptance.
    """

    name: ClassVar[str] = "block-Gibbs annealing"
    budgets: ClassVar[tuple[int, ...]] = (10, 30, 100, 300, 1000, 3000)
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = (
        {},
        {"schedule": "linear"},
        {"range_over_scale": (0.4, 6.0), "schedule": "linear"},
    )

    range_over_scale: tuple[float, float] = (0.4, 12.0)
    schedule: str = "geometric"

    def run(self, problem: Problem, *, n_reads: int, budget: int, seed: int) -> Reads:
        qubo = as_qubo(problem)
        if not isinstance(qubo.graph, Bipartite):
            annealing = SimulatedAnnealing(
                range_over_scale=self.range_over_scale, schedule=self.schedule, acceptance="Gibbs"
            )
            return annealing.run(problem, n_reads=n_reads, budget=budget, seed=seed)
        space = np.geomspace if self.schedule == "geometric" else np.linspace
        betas = space(*self.range_over_scale, budget) / model(problem).scale
        generator, graph = rng.stream(seed, "gibbs"), qubo.graph

        def part(n: int) -> tuple[Tensor, float]:
            begin = time.perf_counter()
            x = _anneal(qubo, graph, betas, n, generator)
            return x, time.perf_counter() - begin

        return in_parts(problem, part, n_reads, 256)


def _anneal(qubo: Qubo, graph: Bipartite, betas: np.ndarray, n_reads: int, generator: Generator) -> Tensor:
    b, c = graph.split(qubo.linear)
    down, up = qubo.coupling.contiguous(), qubo.coupling.mT.contiguous()
    v = (rng.uniform((n_reads, graph.n_first), generator=generator) < 0.5).float()
    h = v.new_zeros(n_reads, graph.n_second)
    draw_v, draw_h = torch.empty_like(v), torch.empty_like(h)
    for beta in betas.tolist():
        for layer, other, weight, bias, draw in ((h, v, up, c, draw_h), (v, h, down, b, draw_v)):
            probability = torch.addmm(bias, other, weight, beta=-beta, alpha=-beta).sigmoid_()
            layer.copy_(draw.uniform_(generator=generator) < probability)
    for _ in range(3):
        h.copy_(torch.addmm(c, v, up) < 0)
        v.copy_(torch.addmm(b, h, down) < 0)
    return torch.cat((v, h), dim=-1)


@dataclass(frozen=True, kw_only=True, slots=True)
class Bifurcation:
    """The package simulated-bifurcation, all reads as agents side by side; budget: steps.

    Its pressure rises over the whole budget (its default: over 1,000 steps).

    Attributes:
        mode: "ballistic" or "discrete".
        heated: With the thermal term.
    """

    name: ClassVar[str] = "simulated bifurcation"
    budgets: ClassVar[tuple[int, ...]] = (100, 300, 1000, 3000, 10_000)
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = (
        {},
        {"mode": "discrete"},
        {"heated": True},
        {"mode": "discrete", "heated": True},
    )

    mode: Literal["ballistic", "discrete"] = "ballistic"
    heated: bool = False

    def run(self, problem: Problem, *, n_reads: int, budget: int, seed: int) -> Reads:
        ising, build = _ising(problem)
        before = torch.get_rng_state()
        simulated_bifurcation.set_env(pressure_slope=10 / budget)  # per unit of time, a step being 0.1 of it
        torch.random.manual_seed(seed)  # the package draws from torch's global generator
        begin = time.perf_counter()
        spins = ising.minimize(
            agents=n_reads,
            max_steps=budget,
            mode=self.mode,
            heated=self.heated,
            early_stopping=False,
            verbose=False,
        )
        seconds = time.perf_counter() - begin
        torch.set_rng_state(before)
        return Reads(energies(problem, spins.T > 0), seconds, build)


@functools.lru_cache(maxsize=2)
def _ising(problem: Problem) -> tuple[Ising, float]:
    """The dense form that the package needs, E = -s'Js / 2 + h's."""
    bqm, _, build = model(problem)
    begin = time.perf_counter()
    fields, (i, j, coupling), _ = bqm.to_numpy_vectors(variable_order=range(len(bqm)))
    matrix = np.zeros((len(bqm), len(bqm)), dtype=np.float32)
    matrix[i, j] = matrix[j, i] = -coupling
    return Ising(matrix, fields.astype(np.float32)), build + time.perf_counter() - begin


@dataclass(frozen=True, kw_only=True, slots=True)
class Dmm:
    """The package's digital memcomputing machine with all its defaults; budget: 0.

    Timed with everything it does. Reads come in calls of its own number of restarts, as a user would call it.
    """

    name: ClassVar[str] = "DMM"
    budgets: ClassVar[tuple[int, ...]] = (0,)
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = ({},)
    field: ClassVar[VectorField[Any, Any]] = ClauseField()

    def run(self, problem: Problem, *, n_reads: int, budget: int, seed: int) -> Reads:
        solver = DmmSolver(field=self.field)
        if budget:
            solver = replace(solver, max_steps=budget, stall=None)
        generator = rng.stream(seed, "dmm")

        def part(n: int) -> tuple[Tensor, float]:
            begin = time.perf_counter()
            solution = replace(solver, n_restarts=n).minimise(problem, generator=generator)
            return solution.assignments, time.perf_counter() - begin

        return in_parts(problem, part, n_reads, solver.n_restarts)


@dataclass(frozen=True, kw_only=True, slots=True)
class DmmTuned(Dmm):
    """The same with its steps tuned like an opponent's; budget: ``max_steps``, all of which each restart does."""

    name: ClassVar[str] = "DMM, steps tuned"
    budgets: ClassVar[tuple[int, ...]] = (30, 100, 300, 1000, 3000, 10_000)


@dataclass(frozen=True, kw_only=True, slots=True)
class DmmBond(DmmTuned):
    """Bond dynamics in place of clause dynamics."""

    name: ClassVar[str] = "DMM bond, steps tuned"
    field: ClassVar[VectorField[Any, Any]] = BondField()


SOLVERS: tuple[type[Opponent], ...] = (
    Dmm,
    DmmTuned,
    DmmBond,
    SimulatedAnnealing,
    Tabu,
    Descent,
    GibbsAnnealing,
    Bifurcation,
)
