"""Tabu search: the best flip, again and again, without undoing the last ones."""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from memcomp_lightning import compiling, rng
from memcomp_lightning.arrays import Array, alike, cast, namespace, to_numpy
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.alternating_descent import random_states
from memcomp_lightning.solvers.base import QuboSolution, Status
from memcomp_lightning.solvers.compiled import (
    Layers,
    Neighbours,
    Numbers,
    check_kernel,
    device_of,
    obstacle,
    power_of_two,
    seeds,
    seen_from_variables,
    share,
    solution_of,
    without_zeros,
)

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


MOST = 2**29
"""Bound of steps, tenure and patience: the kernel counts in 32 bits."""


@dataclass(frozen=True, kw_only=True, slots=True)
class TabuSearch:
    """Solve QUBOs by one-flip tabu search (Glover, Kochenberger & Alidaee 1998), in whole numbers.

    Each step flips the variable that lowers the energy most, or raises it least, but none that flipped lately,
    unless it leads below the best energy. Where nothing better was found for long, the search goes on from its
    best state with some variables flipped at random (Palubeckis 2006). Couplings are rounded to 30 bits; the
    energies of the answer are computed from the assignments.

    Attributes:
        n_restarts: Random starts for each problem, >= 1.
        n_steps: Flips of a restart, >= 1; None is 20 for each variable, at least 500.
        tenure: Steps for which a variable does not flip back, >= 0; None is 10, or a quarter of the variables if
            they are fewer than 40. Up to as many again are added at random.
        patience: Steps without anything better before the search goes back to its best state, >= 1; None is 5 for
            each variable.
        kick: Share of the variables that are flipped then, in (0, 1].
        kernel: "compiled" for the CPU; "reference", plain operations on arrays, for any device; or "auto":
            compiled where it can be.
    """

    n_restarts: int = 28
    n_steps: int | None = None
    tenure: int | None = None
    patience: int | None = None
    kick: float = 0.1
    kernel: Literal["auto", "compiled", "reference"] = "auto"

    def __post_init__(self) -> None:
        require_count("n_restarts", self.n_restarts)
        for name, smallest in (("n_steps", 1), ("tenure", 0), ("patience", 1)):
            if getattr(self, name) is not None:
                require_count(name, getattr(self, name), smallest)
                require(getattr(self, name) < MOST, name, getattr(self, name), f"an integer below {MOST}")
        require(0 < self.kick <= 1, "kick", self.kick, "a number in (0, 1]")
        check_kernel(self.kernel)

    def minimise(self, qubo: Qubo, *, generator: "Generator", start: Array | None = None) -> QuboSolution:
        """Return the best state of each restart.

        Args:
            qubo: One or many problems of one graph.
            generator: Of numpy or torch.
            start: Where each restart begins, ``(*problems, n_restarts, n)`` in {0, 1}; None draws states.
        """
        qubo, begin = qubo.floating(), time.perf_counter() - compiling.seconds_spent()
        n_steps, shape = self.n_steps or max(500, 20 * qubo.n), (*qubo.problems, self.n_restarts, qubo.n)
        if start is None:
            start = random_states(qubo, self.n_restarts, generator)
        require(tuple(start.shape) == shape, "start shape", tuple(start.shape), f"{shape}")
        compiled = self.kernel != "reference" and obstacle(device_of(qubo.linear)) is None and qubo.n > 0
        x, found_at, in_time = (self._compiled if compiled else self._reference)(qubo, n_steps, generator, start)
        late = found_at > 0.9 * n_steps
        status = namespace(x).where(late, int(Status.STILL_IMPROVING), int(Status.STEP_BUDGET))
        return solution_of(qubo, x, begin, steps=n_steps, status=status, was_run=found_at >= 0, in_time=in_time)

    def _settings(self, n: int) -> tuple[int, int, int, int]:
        """Tenure, range of what is added to it, patience and number of variables of a kick."""
        tenure = min(10, n // 4) if self.tenure is None else self.tenure
        return tenure, max(1, tenure), self.patience or 5 * n, max(1, round(self.kick * n))

    def _compiled(
        self, qubo: Qubo, n_steps: int, generator: "Generator", start: Array
    ) -> tuple[Array, Array, bool]:
        """The states, the step of each and whether all came to their end: see ``kernels.tabu``."""
        from memcomp_lightning.solvers.kernels import random, tabu

        problem = seen_from_variables(without_zeros(qubo))
        n_items = len(problem.own) * self.n_restarts
        own_seeds = seeds(n_items, generator)
        unit = _unit(problem)
        couplings = problem.rows(lambda part: _whole(part, unit))
        best, found_at = (to_numpy(start) > 0.5).reshape(n_items, qubo.n), np.full(n_items, -1)
        arguments = (
            couplings,
            _whole(problem.own, unit),
            n_steps,
            self._settings(qubo.n),
            own_seeds,
            best,
            found_at,
        )
        work = n_items * n_steps * qubo.n / 10
        in_time = share(tabu.search, n_items, work, arguments, (random,), anytime=True)
        each = (*qubo.problems, self.n_restarts)
        x = cast(alike(best.reshape(*each, qubo.n), qubo.linear), qubo.linear.dtype)
        return x, alike(found_at.reshape(each), qubo.linear), in_time

    def _reference(
        self, qubo: Qubo, n_steps: int, generator: "Generator", start: Array
    ) -> tuple[Array, Array, bool]:
        """Plain operations on arrays; all restarts go back to their best states after as many steps."""
        xp, x = namespace(qubo.linear), cast(start, qubo.linear.dtype)
        tenure, spread, patience, n_kicked = self._settings(qubo.n)
        best, energy = xp.asarray(x, copy=True), qubo.energy(x)
        lowest, found_at = energy, xp.zeros_like(energy, dtype=xp.int64)
        lately, lately_at = energy, xp.zeros_like(found_at)
        free_from = xp.zeros_like(x, dtype=xp.int64)
        units = xp.arange(qubo.n, device=x.device)
        for step in range(1, n_steps + 1 if qubo.n else 0):
            change = (1 - 2 * x) * qubo.field(x)
            may = (free_from <= step) | (energy[..., None] + change < lowest[..., None])
            chosen = units == xp.where(may, change, xp.inf).argmin(-1)[..., None]
            x = xp.where(chosen, 1 - x, x)
            energy = qubo.energy(x)
            wait = tenure + rng.integers(spread, energy.shape, generator=generator, like=x)
            free_from = xp.where(chosen, step + 1 + wait[..., None], free_from)
            better = energy < lowest
            best, found_at = xp.where(better[..., None], x, best), xp.where(better, step, found_at)
            lowest = xp.minimum(energy, lowest)
            lately_at = xp.where(energy < lately, step, lately_at)
            lately = xp.minimum(energy, lately)
            back = step - lately_at > patience
            if bool(back.any()):
                kicked = rng.uniform(x.shape, generator=generator, like=x) < n_kicked / qubo.n
                x = xp.where(back[..., None], xp.where(kicked, 1 - best, best), x)
                energy, free_from = qubo.energy(x), xp.where(back[..., None], 0, free_from)
                lately, lately_at = xp.where(back, energy, lately), xp.where(back, step, lately_at)
        return best, found_at, True


def _unit(problem: Layers | Neighbours) -> Numbers:
    """What one stands for: a power of two, so that no change of the energy leaves 30 bits, ``(n_problems,)``."""
    return power_of_two(np.abs(problem.own) + problem.strength) * 2.0**-29


def _whole(part: Numbers, unit: Numbers) -> Numbers:
    """Rounded to whole numbers of a unit."""
    return np.ascontiguousarray(np.rint(part / unit.reshape(-1, *(1,) * (part.ndim - 1))), np.int32)
