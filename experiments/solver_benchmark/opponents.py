"""Solvers behind one call, and those of dwave-samplers. One thread each.

What is timed is the search alone. Building the solver's own form of the problem (a dimod model, a dense
matrix) is measured apart, as ``build_seconds``; the DMM is timed with everything it does (``side_by_side``).
"""

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import dimod
import numpy as np
import torch
from dwave.samplers import SimulatedAnnealingSampler, TabuSampler
from torch import Tensor

from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.problems import Qubo, WeightedMaxSat, as_qubo

Problem = Qubo | WeightedMaxSat


class Reads(NamedTuple):
    """What one call found.

    Attributes:
        energies: One a read, float64, of the problem as it was given, computed from the assignments.
        seconds: The search.
        build_seconds: The solver's own form of the problem; not part of ``seconds``.
    """

    energies: np.ndarray
    seconds: float
    build_seconds: float = 0.0


class Opponent(Protocol):
    """A solver with one number to spend: ``budget`` is its effort a read.

    Attributes:
        name: Of the solver, for tables.
        budgets: Values of the sweep.
        variants: Other settings worth trying with every budget, as keyword arguments of the dataclass.
    """

    name: ClassVar[str]
    budgets: ClassVar[tuple[int, ...]]
    variants: ClassVar[tuple[Mapping[str, Any], ...]]

    def run(self, problem: Problem, *, n_reads: int, budget: int, seed: int) -> Reads:
        """Return the energies of ``n_reads`` independent reads."""
        ...


class Model(NamedTuple):
    """A problem in the terms of the annealers."""

    bqm: dimod.BinaryQuadraticModel
    scale: float  # root mean square over the spins of sqrt(sum_j J_ij^2), J in spin form
    seconds: float


@functools.lru_cache(maxsize=2)
def model(problem: Problem) -> Model:
    """The spin form of a problem; the last two are kept."""
    begin = time.perf_counter()
    qubo = as_qubo(problem)
    pairs, coupling = to_numpy(qubo.graph.edges()), qubo.coupling.double().flatten().numpy()
    used = coupling != 0
    (i, j), coupling = pairs[used].T, coupling[used]
    vectors = qubo.linear.double().numpy(), (i, j, coupling), float(qubo.offset)
    bqm = dimod.BinaryQuadraticModel.from_numpy_vectors(*vectors, "BINARY").change_vartype("SPIN", inplace=False)
    squares = np.bincount(i, coupling**2 / 16, qubo.n) + np.bincount(j, coupling**2 / 16, qubo.n)
    return Model(bqm, float(np.sqrt(squares.mean())), time.perf_counter() - begin)


def energies(problem: Problem, x: Tensor) -> np.ndarray:
    """Energies of assignments ``(n_reads, n or more)``; auxiliary variables, if any, come last and are dropped."""
    return np.concatenate([problem.energy(part[:, : problem.n].float()).numpy() for part in x.split(1024)])


def answer(problem: Problem, samples: dimod.SampleSet, seconds: float, build_seconds: float) -> Reads:
    """What a sampler of dimod returned, with the variables in our order and the energies computed anew."""
    order = np.argsort(np.asarray(samples.variables, dtype=np.int64))
    x = torch.from_numpy(np.ascontiguousarray(samples.record.sample[:, order] > 0))
    return Reads(energies(problem, x), seconds, build_seconds)


@dataclass(frozen=True, kw_only=True, slots=True)
class SimulatedAnnealing:
    """dwave-samplers' simulated annealing, single-spin sweeps; budget: sweeps.

    Timed by its own ``sampling_ns``. The default range of temperatures spans the smallest and the largest
    coupling, seven decades for Gaussian weights; the variants tie it to the scale of the couplings instead.

    Attributes:
        range_over_scale: First and last inverse temperature times :attr:`Model.scale`; None is the default.
        schedule: "geometric" or "linear".
        acceptance: "Metropolis" or "Gibbs".
    """

    name: ClassVar[str] = "SA (dwave)"
    budgets: ClassVar[tuple[int, ...]] = (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000, 30_000)
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = (
        {},
        {"range_over_scale": (0.4, 12.0)},
        {"range_over_scale": (0.4, 12.0), "schedule": "linear"},
        {"range_over_scale": (0.4, 6.0), "schedule": "linear"},
        {"range_over_scale": (1.5, 6.0)},
    )

    range_over_scale: tuple[float, float] | None = None
    schedule: str = "geometric"
    acceptance: str = "Metropolis"

    def run(self, problem: Problem, *, n_reads: int, budget: int, seed: int) -> Reads:
        bqm, scale, build = model(problem)
        beta_range = None if self.range_over_scale is None else [beta / scale for beta in self.range_over_scale]
        begin = time.perf_counter()
        samples = SimulatedAnnealingSampler().sample(
            bqm,
            num_reads=n_reads,
            num_sweeps=budget,
            seed=seed,
            beta_range=beta_range,
            beta_schedule_type=self.schedule,
            proposal_acceptance_criteria=self.acceptance,
        )
        wall = time.perf_counter() - begin
        search = samples.info["timing"]["sampling_ns"] * 1e-9
        return answer(problem, samples, search, build + wall - search)


@dataclass(frozen=True, kw_only=True, slots=True)
class Tabu:
    """dwave-samplers' tabu search with restarts within the time; budget: milliseconds a read.

    Timed as reads times budget where the call took longer: the rest is its dense matrix and dimod.

    Attributes:
        tenure: Steps for which a variable stays; None is its default, 20 or a quarter of the variables.
    """

    name: ClassVar[str] = "tabu (dwave)"
    budgets: ClassVar[tuple[int, ...]] = (1, 3, 10, 20, 50, 100, 300, 1000)
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = ({}, {"tenure": 10})

    tenure: int | None = None

    def run(self, problem: Problem, *, n_reads: int, budget: int, seed: int) -> Reads:
        bqm, _, build = model(problem)
        begin = time.perf_counter()
        tenure = None if self.tenure is None else min(self.tenure, len(bqm) - 1)
        samples = TabuSampler().sample(bqm, num_reads=n_reads, timeout=budget, seed=seed, tenure=tenure)
        wall = time.perf_counter() - begin
        search = min(wall, n_reads * budget * 1e-3)
        return answer(problem, samples, search, build + wall - search)
