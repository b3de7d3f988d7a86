"""What a search has found, and what its restarts say together."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

from memcomp_lightning.problems.files.numbers import Exact
from memcomp_lightning.solvers.base import QuboSolution, RecordedStates, Status

PROVEN = (Status.OPTIMAL, Status.INFEASIBLE, Status.ROUNDED)
"""How a search of all states ends: another one would end likewise."""

LEAST_AGREEING, SHARE_AGREEING = 3, 1 / 2
"""Restarts that must have reached the best energy, and the share of the populations, for ``AGREED``."""


class State(NamedTuple):
    """A state that was found.

    Attributes:
        values: Its values: within the solvers ``(n,)`` bool.
        energy: Its energy; exact for a problem from a file or in int64.
        seconds: When it was found, since the search began.
        n_broken: Number of constraints that it breaks.
    """

    values: Any
    energy: Exact | float
    seconds: float
    n_broken: int = 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Found:
    """What a search has found, restarts of all rounds in the order in which they were run.

    Attributes:
        states: Distinct states, the lowest energy first. All keep all constraints, or there is one that breaks the
            fewest.
        curve: Seconds and energy of each better state that keeps all constraints, as they came.
        energies: Of each restart; None where not run.
        broken: Number of constraints that each restart's state breaks.
        status: How each restart ended.
        steps: Integration steps, sweeps or flips of each restart.
        population: Number of the population of each restart; those of different ones are independent.
        lower_bound: No state has a lower energy; minus infinity where none is known.
        resolution: Energies that differ by no more are the same.
        wall_time_s: Seconds in all.
        last: What the last round returned; None if none came to its end.
        interrupted: Whether Ctrl-C ended the search.
        trajectory: What the first round passed through, if its solver was asked to record it.
    """

    states: list[State]
    curve: list[tuple[float, Exact | float]]
    energies: list[Exact | float | None]
    broken: list[int]
    status: list[Status]
    steps: list[int]
    population: list[int]
    lower_bound: float = -math.inf
    resolution: float = 0.0
    wall_time_s: float = 0.0
    last: QuboSolution | None = None
    interrupted: bool = False
    trajectory: RecordedStates | None = None

    @property
    def n_run(self) -> int:
        """Number of restarts that were run."""
        return sum(energy is not None for energy in self.energies)

    @property
    def n_reached(self) -> int:
        """Number of restarts that end at the best energy."""
        return len(self._best())

    @property
    def agree(self) -> bool:
        """Whether three restarts end at the best energy, in two populations and in half of all, at least.

        Descents that CONVERGED do not count: many of them may end in the same wrong minimum.
        """
        reached = [k for k in self._best() if self.status[k] is not Status.CONVERGED]
        populations = {self.population[k] for k, energy in enumerate(self.energies) if energy is not None}
        n_agreeing = len({self.population[k] for k in reached})
        return len(reached) >= LEAST_AGREEING and n_agreeing >= max(2, SHARE_AGREEING * len(populations))

    @property
    def conclusion(self) -> Status:
        """What is known of the best energy: a proof, that restarts agree, or how one ended that reached it."""
        ends = [self.status[k] for k in self._best()]
        proven = next((status for status in PROVEN if status in ends), None)
        if proven is not None:
            return proven
        if self.states[0].n_broken and Status.INFEASIBLE in self.status:
            return Status.INFEASIBLE
        if not self.states[0].n_broken:
            if self.states[0].energy - self.lower_bound <= self.resolution:
                return Status.OPTIMAL
            if self.agree:
                return Status.AGREED
        if self.states[0].n_broken:
            return Status.NOT_FEASIBLE
        return ends[0] if ends else Status.STEP_BUDGET

    def _best(self) -> list[int]:
        """The restarts that end at the best energy."""
        best, each = self.states[0], zip(self.energies, self.broken, strict=True)
        return [
            k
            for k, (energy, n_broken) in enumerate(each)
            if energy is not None and n_broken == best.n_broken and energy - best.energy <= self.resolution
        ]
