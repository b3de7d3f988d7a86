"""Simulated annealing by blocks of uncoupled variables."""

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from memcomp_lightning import compiling, rng
from memcomp_lightning.arrays import Array, alike, cast, double, namespace, sigmoid, to_numpy
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.alternating_descent import descend, random_states
from memcomp_lightning.solvers.base import QuboSolution
from memcomp_lightning.solvers.compiled import (
    Layers,
    Neighbours,
    Numbers,
    check_kernel,
    device_of,
    float32,
    obstacle,
    over,
    power_of_two,
    seeds,
    seen_from_variables,
    share,
    solution_of,
    without_zeros,
)

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


@dataclass(frozen=True, kw_only=True, slots=True)
class GibbsAnnealing:
    r"""Solve QUBOs by simulated annealing: Gibbs sweeps at a rising inverse temperature.

    A sweep draws all blocks of uncoupled variables, in an RBM its layers. Late in the schedule a copy descends to
    a local minimum every few sweeps, and the best of these minima is the answer. Inverse temperatures are
    geometric from ``beta_first / s`` to ``beta_last / s``. The scale of the problem is
    ``s = \sqrt{mean_i \sum_j (Q_ij / 4)^2}`` with the couplings Q_ij / 4 of the spin form; 1 where nothing is
    coupled.

    Attributes:
        n_restarts: Random starts for each problem, >= 1.
        n_sweeps: Sweeps over all variables, >= 1.
        beta_first: Inverse temperature of the first sweep in units of 1 / s, > 0.
        beta_last: Inverse temperature of the last sweep in units of 1 / s, >= beta_first.
        quench_every: Sweeps from one descent of a copy to the next, >= 1, over the last part of the schedule.
        kernel: "compiled" for the CPU; "reference", plain operations on arrays, for any device; or "auto":
            compiled where it can be.
    """

    n_restarts: int = 28
    n_sweeps: int = 100
    beta_first: float = 1.5
    beta_last: float = 5.0
    quench_every: int = 5
    kernel: Literal["auto", "compiled", "reference"] = "auto"

    def __post_init__(self) -> None:
        for name in ("n_restarts", "n_sweeps", "quench_every"):
            require_count(name, getattr(self, name))
        require(self.beta_first > 0, "beta_first", self.beta_first, "a number > 0")
        allowed = f"a number >= beta_first = {self.beta_first}"
        require(self.beta_last >= self.beta_first, "beta_last", self.beta_last, allowed)
        check_kernel(self.kernel)

    @np.errstate(under="ignore")
    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return the best state of each restart."""
        qubo, begin = qubo.floating(), time.perf_counter() - compiling.seconds_spent()
        if self.kernel != "reference" and obstacle(device_of(qubo.linear)) is None and qubo.n > 0:
            x, was_run, in_time = self._compiled(qubo, generator)
            return solution_of(qubo, x, begin, steps=self.n_sweeps, was_run=was_run, in_time=in_time)
        return solution_of(qubo, self._reference(qubo, generator), begin, steps=self.n_sweeps)

    @property
    def _quench_from(self) -> int:
        """The first sweep after which a copy descends."""
        return math.ceil(_HOT * self.n_sweeps)

    def _reference(self, qubo: Qubo, generator: "Generator") -> Array:
        """Plain operations on arrays."""
        xp, x, best = namespace(qubo.linear), random_states(qubo, self.n_restarts, generator), None
        scale = scale_of(qubo)
        for number, beta in enumerate(geometric(self.beta_first, self.beta_last, self.n_sweeps).tolist()):
            sweep(qubo, x, beta / scale, generator)
            late = number - self._quench_from
            if number + 1 == self.n_sweeps or (late >= 0 and late % self.quench_every == 0):
                found = xp.asarray(x, copy=True)
                descend_far(qubo, found)
                energies = qubo.energy(found)
                if best is None:
                    best, lowest = found, energies
                best = xp.where((energies < lowest)[..., None], found, best)
                lowest = xp.minimum(energies, lowest)
        assert best is not None
        return best

    def _compiled(self, qubo: Qubo, generator: "Generator") -> tuple[Array, Array, bool]:
        """The states, which of them were run and whether all came to their end: see ``kernels.annealing``."""
        from memcomp_lightning.solvers.kernels import annealing, random

        problem = seen_from_variables(without_zeros(qubo))
        layered, n_problems = isinstance(problem, Layers), len(problem.own)
        width = 1 if layered else annealing.LANES
        n_items = n_problems * -(-self.n_restarts // width)
        own_seeds = seeds(n_items, generator)
        numbers, over_scale = in_units(qubo, problem)
        betas = float32(geometric(self.beta_first, self.beta_last, self.n_sweeps) * over_scale)
        best = np.full((n_items, qubo.n, width), -1, np.int8)
        kernel = annealing.anneal_layers if layered else annealing.anneal_pairs
        longest = qubo.n if layered else width
        quench = self._quench_from, self.quench_every
        work = n_items * self.n_sweeps * width * problem.size / 10
        arguments = (numbers, betas, quench, random.thresholds(longest), own_seeds, best)
        in_time = share(kernel, n_items, work, arguments, (random,), anytime=True)
        return *states_of(best, qubo, self.n_restarts), in_time


_HOT = 0.3
"""Share of the schedule before the first descent: so early none leads far down."""

_DESCENTS = 4
"""Sweeps of a descent of the reference."""


def in_units(qubo: Qubo, problem: Layers | Neighbours) -> tuple[tuple[Numbers, ...], Numbers]:
    """What the kernels read, in units of a power of two, and the unit over the scale, ``(n_problems, 1)``."""
    unit = power_of_two(problem.couplings, problem.own)
    numbers = (*problem.rows(lambda part: over(part, unit)), over(problem.own, unit))
    return numbers, (unit / to_numpy(scale_of(qubo)).ravel())[:, None]


def states_of(best: Numbers, qubo: Qubo, n_restarts: int | None = None) -> tuple[Array, Array]:
    """The states that the kernels wrote, and which of them were run.

    Args:
        best: ``(n_problems * n_blocks, n, width)``: 0 or 1, and -1 where no time was left.
        qubo: The problems.
        n_restarts: So many of each problem; None is all.
    """
    lanes = best.reshape(math.prod(qubo.problems), -1, *best.shape[1:]).transpose(0, 1, 3, 2)
    states = lanes.reshape(len(lanes), -1, qubo.n)[:, :n_restarts]
    x = np.ascontiguousarray(states).reshape(*qubo.problems, -1, qubo.n)
    return cast(alike(x > 0, qubo.linear), qubo.linear.dtype), alike(x[..., 0] >= 0, qubo.linear)


def geometric(first: float, last: float, n: int) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Inverse temperatures from the first to the last, each the same multiple of the one before."""
    return first * np.logspace(0, 1, n, base=last / first)


def descend_far(qubo: Qubo, x: Array) -> None:
    """Descend for so long that what is left changes little, in place."""
    for _ in range(_DESCENTS):
        descend(qubo, x)


def sweep(qubo: Qubo, x: Array, beta: Array, generator: "Generator") -> None:
    """Draw each block of ``x`` in turn given the rest at inverse temperatures ``(*problems,)``, in place."""
    for block in qubo.graph.blocks():
        p = sigmoid(-cast(beta, x.dtype)[..., None, None] * qubo.field(x)[..., block])
        x[..., block] = rng.bernoulli(p, generator=generator)


def scale_of(qubo: Qubo) -> Array:
    """Root mean square over the variables of the norm of their spin couplings, ``(*problems,)``."""
    power = (double(qubo.coupling) / 4) ** 2
    scale = qubo.graph.scatter(power, power).mean(-1) ** 0.5
    return namespace(scale).where(scale > 0, scale, 1.0)
