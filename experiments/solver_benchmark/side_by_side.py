"""The solvers of the package, and others that run all reads side by side: descent, simulated bifurcation."""

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
from torch import Tensor

from memcomp_lightning import compiling, rng
from memcomp_lightning.problems import Bipartite, as_qubo
from memcomp_lightning.solvers import (
    AlternatingDescent,
    CrossoverAnnealing,
    GibbsAnnealing,
    Portfolio,
    QuboSolver,
    TabuSearch,
)
from memcomp_lightning.solvers.dmm import BondField, ClauseField, DmmSolver, VectorField
from memcomp_lightning.solvers.kernels.annealing import LANES


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
        {"mode": "discrete"},
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
class OfThePackage:
    """A solver of the package, timed with everything it does; budget: see ``_solver``, 0 is all defaults.

    Attributes:
        reads_a_call: So many side by side.
        restarts_a_read: More than one where restarts are not independent: a read is then a whole call.
    """

    name: ClassVar[str]
    budgets: ClassVar[tuple[int, ...]]
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = ({},)
    takes_clauses: ClassVar[bool] = False
    reads_a_call: ClassVar[int] = 256
    restarts_a_read: ClassVar[int] = 1

    def _solver(self, budget: int, n_restarts: int) -> QuboSolver:
        raise NotImplementedError

    def run(self, problem: Problem, *, n_reads: int, budget: int, seed: int) -> Reads:
        given = problem if self.takes_clauses else as_qubo(problem)
        generator = rng.stream(seed, self.name)

        def part(n: int) -> tuple[Tensor, float]:
            begin = time.perf_counter() - compiling.seconds_spent()
            solution = self._solver(budget, n * self.restarts_a_read).minimise(given, generator=generator)
            seconds = time.perf_counter() - compiling.seconds_spent() - begin
            return solution.assignments if self.reads_a_call > 1 else solution.best[None], seconds

        return in_parts(problem, part, n_reads, self.reads_a_call)


@dataclass(frozen=True, kw_only=True, slots=True)
class Best(OfThePackage):
    """The portfolio with its 28 restarts, a read a call; budget: a hundred times its effort."""

    name: ClassVar[str] = "best"
    budgets: ClassVar[tuple[int, ...]] = (30, 100, 300)
    reads_a_call: ClassVar[int] = 1
    restarts_a_read: ClassVar[int] = 28

    def _solver(self, budget: int, n_restarts: int) -> QuboSolver:
        return Portfolio(n_restarts=n_restarts, effort=budget / 100)


@dataclass(frozen=True, kw_only=True, slots=True)
class Annealing(OfThePackage):
    """Gibbs annealing; budget: sweeps."""

    name: ClassVar[str] = "annealing"
    budgets: ClassVar[tuple[int, ...]] = (3, 10, 30, 100, 300, 1000, 3000)

    def _solver(self, budget: int, n_restarts: int) -> QuboSolver:
        return GibbsAnnealing(n_restarts=n_restarts, n_sweeps=budget)


@dataclass(frozen=True, kw_only=True, slots=True)
class Searching(OfThePackage):
    """Tabu search; budget: steps."""

    name: ClassVar[str] = "tabu"
    budgets: ClassVar[tuple[int, ...]] = (30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)

    def _solver(self, budget: int, n_restarts: int) -> QuboSolver:
        return TabuSearch(n_restarts=n_restarts, n_steps=budget)


@dataclass(frozen=True, kw_only=True, slots=True)
class Crossover(OfThePackage):
    """Annealing with crossover, a read a population; budget: sweeps of the first annealing."""

    name: ClassVar[str] = "crossover"
    budgets: ClassVar[tuple[int, ...]] = (30, 100, 300, 1000, 3000)
    reads_a_call: ClassVar[int] = 1
    restarts_a_read: ClassVar[int] = LANES

    def _solver(self, budget: int, n_restarts: int) -> QuboSolver:
        return CrossoverAnnealing(n_restarts=n_restarts, n_sweeps=budget)


@dataclass(frozen=True, kw_only=True, slots=True)
class Dmm(OfThePackage):
    """The package's digital memcomputing machine with all its defaults; budget: 0."""

    name: ClassVar[str] = "DMM"
    budgets: ClassVar[tuple[int, ...]] = (0,)
    takes_clauses: ClassVar[bool] = True
    reads_a_call: ClassVar[int] = 28
    field: ClassVar[VectorField[Any, Any]] = ClauseField()

    def _solver(self, budget: int, n_restarts: int) -> QuboSolver:
        solver: Any = DmmSolver(field=self.field, n_restarts=n_restarts)
        return replace(solver, max_steps=budget, stall=None) if budget else solver


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
    Best,
    Annealing,
    Searching,
    Crossover,
    Dmm,
    DmmTuned,
    DmmBond,
    SimulatedAnnealing,
    Tabu,
    Descent,
    Bifurcation,
)
OF_THE_PACKAGE = tuple(kind.name for kind in SOLVERS if issubclass(kind, OfThePackage))
