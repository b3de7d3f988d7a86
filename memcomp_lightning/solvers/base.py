"""What every solver of a QUBO takes and gives back, and how each restart ended."""

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Protocol

import numpy as np

from memcomp_lightning.arrays import Array, namespace, to_numpy
from memcomp_lightning.problems.qubo import Qubo

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


class Status(IntEnum):
    """How one restart of a solver ended; ``advice`` says what to do about it."""

    OPTIMAL = 0
    CONVERGED = 1
    STEP_BUDGET = 2
    STILL_IMPROVING = 3
    NOT_RUN = 4
    STALLED = 5
    INFEASIBLE = 6
    ROUNDED = 7

    @property
    def advice(self) -> str:
        """One sentence for a person."""
        return _ADVICE[self]


_ADVICE = {
    Status.OPTIMAL: "Proven: no state has a lower energy.",
    Status.CONVERGED: "No block of variables improves this assignment; more restarts may find a lower one.",
    Status.STEP_BUDGET: "The best assignment came long before the last step; more restarts may find a lower one.",
    Status.STILL_IMPROVING: "The best assignment came in the last tenth of the steps: raise max_steps.",
    Status.STALLED: "Nothing better for far longer than the best one took; more restarts may find a lower one.",
    Status.INFEASIBLE: "Every state was examined: none satisfies all hard clauses; this one breaks the fewest.",
    Status.ROUNDED: "The search was complete, but float64 rounds sums of these numbers: another may be lower.",
    Status.NOT_RUN: "Not run: enough restarts before it had found nothing better.",
}


class RecordedStates(Protocol):
    """States that a solver passed through, as samples of low energy."""

    @property
    def assignments(self) -> Array:
        """``(*problems, n_restarts, n_records, n)``, bool."""

    def weights(self) -> Array:
        """How much each of them counts in an average, >= 0, ``(*problems, n_restarts, n_records)``."""


@dataclass(frozen=True, slots=True, eq=False)
class QuboSolution:
    """Answers of all restarts, as arrays of the library that the problem's numbers are of.

    Attributes:
        assignments: ``(*problems, n_restarts, n)`` in {0, 1}, dtype of the problem.
        energies: ``(*problems, n_restarts)`` float64, computed from the assignments; infinite where not run.
        status: ``(*problems, n_restarts)`` int64, values of :class:`Status`.
        steps: ``(*problems, n_restarts)`` int64, integration steps or sweeps done.
        wall_time_s: Seconds for all problems and restarts together.
        trajectory: What the solver passed through, if it was asked to record it.
    """

    assignments: Array
    energies: Array
    status: Array
    steps: Array
    wall_time_s: float
    trajectory: RecordedStates | None = None

    @property
    def best_energy(self) -> Array:
        """Lowest energy over the restarts, ``(*problems,)`` float64."""
        return namespace(self.energies).min(self.energies, axis=-1)

    @property
    def best(self) -> Array:
        """Assignment of lowest energy, ``(*problems, n)``."""
        xp, index = namespace(self.energies), self.energies.argmin(-1)[..., None, None]
        index = xp.broadcast_to(index, (*index.shape[:-1], self.assignments.shape[-1]))
        return xp.take_along_axis(self.assignments, index, axis=-2)[..., 0, :]

    def messages(self) -> dict[str, int]:
        """How many restarts ended in each way, keyed by name and advice."""
        values, counts = np.unique(to_numpy(self.status), return_counts=True)
        return {
            f"{Status(int(value)).name}: {Status(int(value)).advice}": int(count)
            for value, count in zip(values, counts, strict=True)
        }


class QuboSolver(Protocol):
    """Anything that looks for minima of a :class:`Qubo`, several problems and restarts a call.

    A solver that stops early says so in ``status``; it does not raise inside a training run.
    """

    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return the assignments found, one a restart.

        Args:
            qubo: One or many problems of one graph.
            generator: The source of random numbers, of numpy or torch, whatever the problem is made of.
        """
