"""What every solver of a QUBO takes and gives back, and how each restart ended."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Protocol

from memcomp_lightning.arrays import Array, namespace, to_numpy
from memcomp_lightning.problems.qubo import Qubo

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


class Status(IntEnum):
    """How one restart of a solver ended; ``advice`` says what to do about it, one sentence for a person."""

    advice: str

    def __new__(cls, value: int, advice: str = "") -> "Status":
        """A number with its advice."""
        status = int.__new__(cls, value)
        status._value_, status.advice = value, advice
        return status

    OPTIMAL = 0, "Proven: no state has a lower energy."
    CONVERGED = 1, "No block of variables improves this assignment; more restarts may find a lower one."
    STEP_BUDGET = 2, "The best assignment came long before the last step; more restarts may find a lower one."
    STILL_IMPROVING = (
        3,
        "The best assignment came in the last tenth of the steps: more steps may find a lower one.",
    )
    NOT_RUN = 4, "Not run: enough restarts before it had found nothing better, or no time was left."
    STALLED = 5, "Nothing better for far longer than the best one took; more restarts may find a lower one."
    INFEASIBLE = 6, "Proven: no state keeps all constraints."
    ROUNDED = 7, "The search was complete, but float64 rounds sums of these numbers: another may be lower."
    NOT_FEASIBLE = 8, "No assignment that keeps all constraints was found; more restarts may find one."
    STOPPED = 9, "The time was up, or Ctrl-C came: a longer search may find a lower one."
    AGREED = 10, "Not proven, but many independent restarts reached this energy and none went below it."


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
        broken: Number of constraints that each assignment breaks, ``(*problems, n_restarts)`` int64; None where
            the problem has none.
        population: Number of the population of each restart, ``(*problems, n_restarts)`` int64: those of one are
            not independent. None where each is on its own.
    """

    assignments: Array
    energies: Array
    status: Array
    steps: Array
    wall_time_s: float
    trajectory: RecordedStates | None = None
    broken: Array | None = None
    population: Array | None = None

    @property
    def best_energy(self) -> Array:
        """Energy of :attr:`best`, ``(*problems,)`` float64."""
        return namespace(self.energies).min(self._ranked, axis=-1)

    @property
    def best(self) -> Array:
        """Assignment of lowest energy among those that break the fewest constraints, ``(*problems, n)``."""
        xp, index = namespace(self.energies), self._ranked.argmin(-1)[..., None, None]
        index = xp.broadcast_to(index, (*index.shape[:-1], self.assignments.shape[-1]))
        return xp.take_along_axis(self.assignments, index, axis=-2)[..., 0, :]

    @property
    def _ranked(self) -> Array:
        """Energies, infinite where another assignment breaks fewer constraints."""
        if self.broken is None:
            return self.energies
        xp = namespace(self.energies)
        fewest = xp.min(self.broken, axis=-1)[..., None]
        return xp.where(self.broken == fewest, self.energies, xp.inf)

    def lowest(self, n: int) -> "QuboSolution":
        """The ``n`` restarts of lowest energy of each problem, lowest first, or all if they are fewer."""
        xp, order = namespace(self.energies), namespace(self.energies).argsort(self._ranked, axis=-1)[..., :n]
        places = xp.broadcast_to(order[..., None], (*order.shape, self.assignments.shape[-1]))
        chosen = {name: xp.take_along_axis(part, order, axis=-1) for name, part in self._of_restarts().items()}
        return replace(self, assignments=xp.take_along_axis(self.assignments, places, axis=-2), **chosen)

    @staticmethod
    def joined(parts: "Sequence[QuboSolution]", wall_time_s: float) -> "QuboSolution":
        """The restarts of several solutions of the same problems, with the trajectory of the last one."""
        concat, rows = namespace(parts[0].energies).concat, [part._of_restarts() for part in parts]
        if any("population" in row for row in rows):
            first = 0
            for row in rows:
                each = namespace(row["status"]).ones_like(row["status"])
                alone = namespace(each).cumulative_sum(each, axis=-1) - 1
                row["population"] = first + row.get("population", alone)
                first += row["status"].shape[-1]
        return QuboSolution(
            assignments=concat([part.assignments for part in parts], axis=-2),
            wall_time_s=wall_time_s,
            trajectory=parts[-1].trajectory,
            **{name: concat([row[name] for row in rows], axis=-1) for name in rows[0]},
        )

    def _of_restarts(self) -> dict[str, Array]:
        """What there is one number a restart of, ``(*problems, n_restarts)``."""
        names = ("energies", "status", "steps", "broken", "population")
        return {name: part for name in names if (part := getattr(self, name)) is not None}

    def messages(self) -> dict[str, int]:
        """How many restarts ended in each way, keyed by name and advice."""
        counts = Counter(Status(value) for value in to_numpy(self.status).ravel().tolist())
        return {f"{status.name}: {status.advice}": counts[status] for status in sorted(counts)}


class QuboSolver(Protocol):
    """Anything that looks for minima of a :class:`Qubo`, several problems and restarts a call.

    A solver that stops early says so in ``status``; it does not raise inside a training run.
    """

    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return the assignments found for one or many problems of one graph, one a restart.

        Random numbers come from the generator, of numpy or torch, whatever the problem is made of.
        """
