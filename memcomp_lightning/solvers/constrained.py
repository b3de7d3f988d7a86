"""Problems with constraints by any solver of QUBOs: penalties, repair, and higher penalties."""

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from memcomp_lightning import compiling
from memcomp_lightning.arrays import Array, add_up, alike, as_array, double, namespace, to_numpy
from memcomp_lightning.errors import require_count, require_parts
from memcomp_lightning.problems.constrained import Constrained, sums_of
from memcomp_lightning.problems.maxsat import WeightedMaxSat, as_qubo, to_qubo
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver, Status
from memcomp_lightning.solvers.compiled import Numbers
from memcomp_lightning.solvers.repair import repair

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


@dataclass(frozen=True, kw_only=True, slots=True)
class PenaltyLoop:
    """Solve problems with constraints by a solver that knows none.

    A round gives the solver the objective plus a penalty for each broken constraint, and mends its answers
    (:func:`~memcomp_lightning.solvers.repair.repair`). Penalties begin at what breaking the constraint can gain
    (:func:`local_penalties`): a larger one hides the objective. Where an answer with broken constraints has less
    energy than the best without, these constraints cost too little: their penalties double, and the next round
    begins. Where no round found an answer that keeps all constraints, the last one takes penalties with which
    breaking one never pays.

    Attributes:
        solver: The solver.
        n_rounds: Most rounds, >= 1.
    """

    solver: QuboSolver
    n_rounds: int = 6

    def __post_init__(self) -> None:
        require_parts("solver", self.solver, "solver", ("minimise",))
        require_count("n_rounds", self.n_rounds)

    def minimise(self, problem: Constrained, *, generator: "Generator") -> QuboSolution:
        """Return the answers of all rounds, mended, with the number of constraints that each still breaks.

        Energies are those of the objective. A minimum that the solver proves is OPTIMAL here if it breaks nothing;
        if it breaks something although that never pays, it is INFEASIBLE.
        """
        begin = time.perf_counter() - compiling.seconds_spent()
        rows, penalties, safe = problem.constraints, local_penalties(problem), safe_penalty(problem)
        found, lowest = list[QuboSolution](), np.full(problem.objective.problems, np.inf)
        for k in range(self.n_rounds):
            if k and k == self.n_rounds - 1:
                penalties = np.where(np.isinf(lowest)[..., None], safe, penalties)
            given = problem.penalised(as_array(penalties))
            if not getattr(self.solver, "takes_clauses", False):
                given = as_qubo(given)
            solution = self.solver.minimise(given, generator=generator)  # type: ignore[arg-type]
            raw = solution.assignments[..., : problem.n]
            broken = rows.excess(rows.sums(to_numpy(raw) > 0.5)) > 0
            hopeless = alike(np.any(broken & (penalties >= safe)[..., None, :], axis=-1), raw)
            found.append(_mended(problem, solution, raw, hopeless))
            kept = to_numpy(problem.n_broken(found[-1].best)) == 0
            lowest = np.where(kept, np.minimum(to_numpy(found[-1].best_energy), lowest), lowest)
            # Less energy than the best answer that keeps all constraints: to break some pays.
            pays = to_numpy(solution.energies) < lowest[..., None] - _LEAST * safe
            too_cheap = (broken & pays[..., None]).any(-2) & (penalties < safe)
            if not too_cheap.any():
                break
            penalties = np.where(too_cheap, np.minimum(2 * penalties, safe), penalties)
        concat = namespace(found[0].energies).concat
        return QuboSolution(
            assignments=concat([solution.assignments for solution in found], axis=-2),
            energies=concat([solution.energies for solution in found], axis=-1),
            status=concat([solution.status for solution in found], axis=-1),
            steps=concat([solution.steps for solution in found], axis=-1),
            wall_time_s=time.perf_counter() - compiling.seconds_spent() - begin,
            trajectory=found[-1].trajectory,
            broken=concat([solution.broken for solution in found], axis=-1),
        )


def _mended(problem: Constrained, solution: QuboSolution, raw: Array, hopeless: Array) -> QuboSolution:
    """The answers of a round, in the terms of the problem.

    Args:
        problem: The problem.
        solution: Answers of the solver.
        raw: Their states of the problem's variables, ``(*problems, n_restarts, n)``.
        hopeless: Whether they break a constraint although that never pays, ``(*problems, n_restarts)``.
    """
    xp, x, was_run = namespace(raw), repair(problem, raw), solution.energies < namespace(raw).inf
    broken = xp.where(was_run, problem.n_broken(x), len(problem.constraints))
    proven = solution.status == int(Status.OPTIMAL)
    status = xp.where(proven & (problem.n_broken(raw) > 0), int(Status.CONVERGED), solution.status)
    status = xp.where(was_run & (broken > 0), int(Status.NOT_FEASIBLE), status)
    status = xp.where(proven & hopeless, int(Status.INFEASIBLE), status)
    energies = xp.where(was_run, problem.energy(x), xp.inf)
    return replace(solution, assignments=x, energies=energies, status=status, broken=broken)


_LEAST = 1e-9
"""Differences of energies that may be rounding errors, as a share of what the objective reaches."""


def safe_penalty(problem: Constrained) -> Numbers:
    """A penalty with which no state that breaks a constraint is a minimum, ``(*problems, 1)``."""
    return _power_of_two_above(np.add(*_largest_changes(problem.objective)).sum(-1, keepdims=True))


def local_penalties(problem: Constrained) -> Numbers:
    """What breaking each constraint can gain, seen from its own variables, ``(*problems, n_constraints)``.

    Whoever mends a broken constraint flips one of its variables, which raises the objective by no more than all
    that pulls at this variable; the cheapest one counts. Where the flip may break another constraint, about the
    mean of such pulls is added.
    """
    rows, (on, off) = problem.constraints, _largest_changes(problem.objective)
    most = np.maximum(on, off)
    n_pulled = (most > 0).sum(-1, keepdims=True)
    typical = _power_of_two_above(most.sum(-1, keepdims=True) / np.maximum(n_pulled, 1)) / 2
    row, x, rises = rows.row, rows.variables, rows.coefficients > 0
    filled = rows.lengths > 0
    from_above = rows.upper < sums_of(np.maximum(rows.coefficients, 0), rows.begins)
    hurts_on, hurts_off = ~rises | from_above[row], rises | from_above[row]
    costs = []
    for change, hurts in ((on, hurts_on), (off, hurts_off)):
        others = np.bincount(x, hurts, minlength=problem.n)[x] - hurts
        costs.append(change[..., x] + typical * (others > 0))
    penalties = np.zeros((*problem.objective.problems, len(rows)))
    for raises, wanted in ((rises, filled), (~rises, filled & from_above)):
        cheapest = np.minimum.reduceat(np.where(raises, *costs), rows.begins[:-1][filled], axis=-1)
        penalties[..., wanted] = np.maximum(penalties[..., wanted], cheapest[..., wanted[filled]])
    return np.minimum(np.where(penalties > 0, penalties, typical), safe_penalty(problem))


def _power_of_two_above(x: Numbers) -> Numbers:
    """A power of two above a number >= 0, with which sums of whole numbers stay exact."""
    return np.exp2(np.frexp(x)[1])


def _largest_changes(objective: Qubo | WeightedMaxSat) -> tuple[Numbers, Numbers]:
    """What turning each variable on, and off, adds to the objective at most, ``(*problems, n)`` each, >= 0."""
    short = objective if isinstance(objective, Qubo) else to_qubo(objective.without_longer())
    graph, coupling, linear = short.graph, double(short.coupling), double(short.linear)
    above, below = (linear + graph.scatter(part, part) for part in (coupling.clip(min=0), coupling.clip(max=0)))
    on, off = to_numpy(above).clip(min=0), -to_numpy(below).clip(max=0)
    for block in () if isinstance(objective, Qubo) else objective.longer:
        for change, polarity in ((on, -1), (off, 1)):
            pull = double(block.weight)[..., None] * (block.polarity == polarity)
            flat = pull.reshape(*pull.shape[:-2], -1)
            change += to_numpy(add_up(flat, block.variables.reshape(-1), objective.n))
    return on, off
