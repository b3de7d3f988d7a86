"""Annealing of a population whose states trade their independent parts, for sparse problems."""

import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from memcomp_lightning import compiling, rng
from memcomp_lightning.arrays import Array, add_up, alike, double, namespace, to_numpy
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.alternating_descent import random_states
from memcomp_lightning.solvers.annealing import descend_far, geometric, in_units, scale_of, states_of, sweep
from memcomp_lightning.solvers.base import QuboSolution
from memcomp_lightning.solvers.compiled import (
    check_kernel,
    device_of,
    float32,
    listed,
    obstacle,
    seeds,
    seen_from_variables,
    share,
    solution_of,
)

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


@dataclass(frozen=True, kw_only=True, slots=True)
class CrossoverAnnealing:
    """Solve sparse QUBOs by annealing a population whose states trade their independent parts.

    After a first annealing each round reheats a copy of every state to some temperature, cools it, and crosses
    it with the state it came from; every third round states cross with one another. Crossing is partition
    crossover (Whitley, Hains & Howe 2009; Tinós, Whitley & Chicano 2015): the variables in which two states
    differ fall into parts that are not coupled, and each part that does not raise the energy is taken over. So
    the regions of a sparse graph improve independently of one another. On a dense problem there is one part, and
    a round keeps the better of both states.

    Attributes:
        n_restarts: States for each problem, >= 1. Those of a population of 16 are not independent.
        n_sweeps: Sweeps of the first annealing, >= 1; a round has a tenth of them.
        n_rounds: Rounds, >= 0.
        beta_first: Inverse temperature of the first sweep in the units of ``GibbsAnnealing``, > 0.
        beta_last: Inverse temperature at the end of the first annealing and of each round, >= beta_first.
        reheat_first: Least inverse temperature that a round begins with, > 0.
        reheat_last: Largest one, >= reheat_first; each round draws its own.
        kernel: "compiled" for the CPU; "reference", plain operations on arrays, for any device; or "auto":
            compiled where it can be.
    """

    n_restarts: int = 28
    n_sweeps: int = 400
    n_rounds: int = 40
    beta_first: float = 0.8
    beta_last: float = 6.0
    reheat_first: float = 1.5
    reheat_last: float = 4.0
    kernel: Literal["auto", "compiled", "reference"] = "auto"

    def __post_init__(self) -> None:
        require_count("n_restarts", self.n_restarts)
        require_count("n_sweeps", self.n_sweeps)
        require_count("n_rounds", self.n_rounds, 0)
        for first, last in (("beta_first", "beta_last"), ("reheat_first", "reheat_last")):
            least, most = getattr(self, first), getattr(self, last)
            require(least > 0, first, least, "a number > 0")
            require(most >= least, last, most, f"a number >= {first} = {least}")
        check_kernel(self.kernel)

    @np.errstate(under="ignore")
    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return the best states of the populations, best first."""
        begin = time.perf_counter() - compiling.seconds_spent()
        qubo = listed(qubo.floating())
        if self.kernel != "reference" and obstacle(device_of(qubo.linear)) is None and qubo.n > 0:
            from memcomp_lightning.solvers.kernels.annealing import LANES

            (x, was_run, in_time), size = self._compiled(qubo, generator), LANES
        else:
            x, was_run, in_time, size = self._reference(qubo, generator), None, True, self.n_restarts
        solution = solution_of(qubo, x, begin, steps=self._n_all, was_run=was_run, in_time=in_time)
        numbers = np.broadcast_to(np.arange(x.shape[-2]) // size, x.shape[:-1])
        return replace(solution, population=alike(numbers, solution.steps)).lowest(self.n_restarts)

    @property
    def _n_short(self) -> int:
        """Sweeps of a round."""
        return max(1, self.n_sweeps // 10)

    @property
    def _n_all(self) -> int:
        """Sweeps of the first annealing and of all rounds."""
        return self.n_sweeps + self.n_rounds * self._n_short

    def _reference(self, qubo: Qubo, generator: "Generator") -> Array:
        """Plain operations on arrays; all states of a problem are one population."""
        xp, kept, scale = namespace(qubo.linear), random_states(qubo, self.n_restarts, generator), scale_of(qubo)
        for beta in geometric(self.beta_first, self.beta_last, self.n_sweeps).tolist():
            sweep(qubo, kept, beta / scale, generator)
        descend_far(qubo, kept)
        for number in range(1, self.n_rounds + 1):
            x, u = xp.asarray(kept, copy=True), rng.uniform((), generator=generator, like=scale)
            first = self.reheat_first * (self.reheat_last / self.reheat_first) ** float(u)
            for step in range(self._n_short):
                beta = first + (self.beta_last - first) * step / self._n_short
                sweep(qubo, x, beta / scale, generator)
            descend_far(qubo, x)
            kept = _cross(qubo, kept, x)
            if number % _CROSS_EVERY == 0 and self.n_restarts > 1:
                shift = 1 + int(rng.integers(self.n_restarts - 1, (), generator=generator, like=scale))
                kept = _cross(qubo, kept, xp.roll(kept, shift, axis=-2))
            descend_far(qubo, kept)
        return kept

    def _compiled(self, qubo: Qubo, generator: "Generator") -> tuple[Array, Array, bool]:
        """Sixteen states side by side, see ``kernels.crossover``."""
        from memcomp_lightning.solvers.kernels import annealing, crossover, random

        problem = seen_from_variables(qubo)
        n_populations = -(-self.n_restarts // annealing.LANES)
        own_seeds = seeds(len(problem.own) * n_populations, generator)
        numbers, over_scale = in_units(qubo, problem)
        reheat = float32(self.reheat_first * over_scale[:, 0]), np.float32(self.reheat_last / self.reheat_first)
        rounds = self.n_rounds, self._n_short, _CROSS_EVERY
        best = np.full((len(own_seeds), qubo.n, annealing.LANES), -1, np.int8)
        betas = float32(geometric(self.beta_first, self.beta_last, self.n_sweeps) * over_scale)
        arguments = (numbers, betas, reheat, rounds, random.thresholds(annealing.LANES), own_seeds, best)
        work = best.size * self._n_all * max(1, problem.size // max(qubo.n, 1)) / 10
        in_time = share(crossover.evolve, len(own_seeds), work, arguments, (annealing, random), anytime=True)
        return *states_of(best, qubo), in_time


_CROSS_EVERY = 3
"""Rounds from one crossing of the states with one another to the next: at each one they become alike too soon."""


def _cross(qubo: Qubo, x: Array, other: Array) -> Array:
    """Take over from other states each part that does not raise the energy, see ``kernels.crossover``."""
    xp, differs = namespace(x), x != other
    change = double(other - x) * double(qubo.field(x) + qubo.field(other)) / 2
    part = alike(_parts(to_numpy(qubo.graph.edges()), to_numpy(differs)), x)
    by_part = add_up(change.reshape(-1), part.reshape(-1), math.prod(part.shape))
    return xp.where(differs & (by_part[part] <= 0), other, x)


def _parts(pairs: np.ndarray, differs: np.ndarray) -> np.ndarray:
    """Number of the connected component of each variable among those that differ, of each state."""
    from scipy.sparse import coo_array  # the compiled kernel does without, and starts sooner
    from scipy.sparse.csgraph import connected_components

    both = differs[..., pairs[:, 0]] & differs[..., pairs[:, 1]]
    n, states = differs.shape[-1], both.reshape(math.prod(both.shape[:-1]), -1).nonzero()
    ends = (states[0] * n + pairs[states[1], end] for end in (0, 1))
    size = differs.size
    graph = coo_array((np.ones(len(states[0]), np.bool_), tuple(ends)), shape=(size, size))
    return connected_components(graph, directed=False)[1].reshape(differs.shape).astype(np.int64)
