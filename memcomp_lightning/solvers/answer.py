"""What a solver found, in the terms of the file that the problem comes from."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning import __version__
from memcomp_lightning.arrays import as_array, namespace, to_numpy
from memcomp_lightning.errors import require
from memcomp_lightning.files import write_text
from memcomp_lightning.problems.files.numbers import Exact, in_full
from memcomp_lightning.problems.files.objective import Score
from memcomp_lightning.problems.problem import Problem
from memcomp_lightning.solvers.base import QuboSolution, Status
from memcomp_lightning.solvers.found import Found


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A solver's answer in the terms of the problem's file, counted without rounding.

    Attributes:
        assignment: The one of lowest energy, with a value for every variable of the file, ``(n,)`` bool.
        score: Its score.
        energy: Its energy: the score's value, or minus it if that is maximised, plus the penalty of each
            unsatisfied hard clause.
        energies: Energy of each restart; None where it was not run.
        status: How each restart ended. A proven minimum that leaves a hard clause unsatisfied is INFEASIBLE,
            another answer that does NOT_FEASIBLE; a minimum that rests on rounded sums is ROUNDED.
    """

    assignment: NDArray[np.bool_]
    score: Score
    energy: Exact | float
    energies: list[Exact | float | None]
    status: list[Status]

    @property
    def n_run(self) -> int:
        """Number of restarts that were run."""
        return sum(energy is not None for energy in self.energies)

    @property
    def n_reached(self) -> int:
        """Number of restarts that end at the best energy."""
        return self.energies.count(self.energy)

    @property
    def optimal(self) -> bool:
        """Whether this is proven to be the best that there is."""
        return Status.OPTIMAL in self.status

    @staticmethod
    def of(problem: Problem, solution: QuboSolution | Found) -> "Answer":
        """What a solver or a search found of the problem, in the terms of the problem's file.

        Raises:
            SettingError: The solution is of more than one problem.
        """
        if isinstance(solution, Found):
            best, energies, status = solution.states[0].values, solution.energies, solution.status
        else:
            energies, _, status = in_full_of(problem, solution)
            _, k = min((energy, k) for k, energy in enumerate(energies) if energy is not None)
            best = to_numpy(solution.assignments[k]) > 0.5
        score = problem.score(as_array(best))
        return Answer(problem.expand(as_array(best)), score, problem.objective.energy(score), energies, status)


def in_full_of(
    problem: Problem, solution: QuboSolution
) -> tuple[list[Exact | float | None], list[int], list[Status]]:
    """Energy, unsatisfied hard clauses and status of each restart as an :class:`Answer` has them.

    Raises:
        SettingError: The solution is of more than one problem.
    """
    require(solution.energies.ndim == 1, "energies' shape", tuple(solution.energies.shape), "(n_restarts,)")
    # Solvers return the dtype of what they were given: integers were compared as integers.
    exact = problem.resolved or solution.assignments.dtype == namespace(solution.assignments).int64
    status = [Status(code) for code in solution.status.tolist()]
    energies: list[Exact | float | None] = [None] * len(status)
    broken = [0] * len(status)
    for k, rounded in enumerate(solution.energies.tolist()):
        if not math.isfinite(rounded):
            continue
        score = problem.score(solution.assignments[k])
        energies[k], broken[k] = problem.objective.energy(score), score.hard_unsatisfied
        if status[k] is Status.OPTIMAL and not exact:
            status[k] = Status.ROUNDED
        if score.hard_unsatisfied:
            proven = status[k] in (Status.OPTIMAL, Status.INFEASIBLE)
            status[k] = Status.INFEASIBLE if proven else Status.NOT_FEASIBLE
    return energies, broken, status


def write_solution(
    path: Path, problem: Problem, solution: QuboSolution | Found, *, solver: Mapping[str, object], seed: int
) -> None:
    """Write the answer to one problem as JSON, whole or not at all, with the solver's settings and its seed.

    Of a search it has the states that were kept and the curve, too.

    Raises:
        SettingError: The answer is to more than one problem.
    """
    answer = Answer.of(problem, solution)
    objective = {
        "name": problem.objective.name,
        "direction": problem.objective.direction,
        **_in_json("value", answer.score.value),
    }
    if "hard_clauses" in problem.sizes:
        objective["hard_clauses_unsatisfied"] = answer.score.hard_unsatisfied
    sizes = {f"n_{kind}": number for kind, number in problem.sizes.items()}
    if problem.n_unused:
        sizes["n_unused_variables"] = problem.n_unused
    content = {
        "problem": {
            "file": str(problem.path),
            "name": problem.name,
            "format": problem.format,
            **sizes,
            **({"remarks": problem.remarks} if problem.remarks else {}),
        },
        **_in_json("energy", answer.energy),
        "objective": objective,
        "assignment": answer.assignment,
        **(_of_search(problem, solution) if isinstance(solution, Found) else {}),
        "restarts": {
            "energy": [None if energy is None else _nearest(energy) for energy in answer.energies],
            "status": [status.name for status in answer.status],
            "steps": solution.steps if isinstance(solution, Found) else solution.steps.tolist(),
        },
        "wall_time_s": solution.wall_time_s,
        "solver": dict(solver),
        "seed": seed,
        "memcomp_lightning": __version__,
    }
    lines = ",\n".join(f" {json.dumps(name)}: {_json(value)}" for name, value in content.items())
    write_text(path, f"{{\n{lines}\n}}\n")


def _of_search(problem: Problem, found: Found) -> dict[str, object]:
    """What a search knows beyond its best state."""
    others = [
        {"assignment": problem.expand(state.values).astype(int).tolist(), **_in_json("energy", state.energy)}
        for state in found.states[1:]
    ]
    bound = {"lower_bound": found.lower_bound} if math.isfinite(found.lower_bound) else {}
    return {
        "status": found.conclusion.name,
        **bound,
        "curve": [[round(seconds, 6), _nearest(energy)] for seconds, energy in found.curve],
        **({"other_solutions": others} if others else {}),
    }


def _json(value: object) -> str:
    """A value as JSON; an assignment digit by digit, as it may have millions."""
    if isinstance(value, np.ndarray):
        return f"[{', '.join(map(str, value.astype(int).tolist()))}]"
    return json.dumps(value, allow_nan=False)


def _nearest(value: Exact | float) -> int | float:
    """A number that JSON has: integers whole, fractions rounded to float64."""
    whole = isinstance(value, float) and value.is_integer() and abs(value) <= 2**53
    return int(value) if whole else float(value) if isinstance(value, Fraction) else value


def _in_json(name: str, value: Exact | float) -> dict[str, int | float | str]:
    """A number, and all digits of a fraction that float64 rounds."""
    written: dict[str, int | float | str] = {name: _nearest(value)}
    if isinstance(value, Fraction) and Fraction(repr(float(value))) != value:
        written[f"{name}_in_full"] = in_full(value)
    return written
