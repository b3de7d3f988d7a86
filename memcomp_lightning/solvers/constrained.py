"""Problems with constraints by any solver of QUBOs: penalties, repair, and higher penalties."""

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from memcomp_lightning import compiling
from memcomp_lightning.arrays import Array, add_up, alike, as_array, double, namespace, to_numpy
from memcomp_lightning.errors import require_count, require_parts
from memcomp_lightning.problems.constrained import Constrained, sums_of
from memcomp_lightning.problems.maxsat import as_qubo, to_qubo
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.problems.rows import Integers
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver, Status
from memcomp_lightning.solvers.compiled import Numbers, limit_here
from memcomp_lightning.solvers.groups import descend, groups_of, guides, shifted
from memcomp_lightning.solvers.repair import repair

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


@dataclass(frozen=True, kw_only=True, slots=True)
class PenaltyLoop:
    """Solve problems with constraints by a solver that knows none.

    A turn gives the solver the objective plus a penalty for each broken constraint, and mends its answers
    (:func:`~memcomp_lightning.solvers.repair.repair`). Penalties begin at what breaking the constraint may gain
    (:func:`local_penalties`): larger ones hide the objective. Where an answer with broken constraints has less
    energy than the best without, these constraints cost too little: their penalties double, in the second half of
    the turns all penalties, and the next turn begins. Where none has after the first turn, but its best answer
    would gain less by breaking constraints (:func:`gains`), there is a second one with smaller penalties.
    Where each constraint asks for exactly one of variables of its own, the first penalties are read from states of
    low energy (:mod:`~memcomp_lightning.solvers.groups`), and answers descend by moves within the groups.
    Where no answer keeps all constraints, the last turn takes penalties with which breaking one never pays; so it
    does for a solver that proves its minima.

    Attributes:
        solver: The solver.
        n_turns: Most turns, >= 1.
    """

    solver: QuboSolver
    n_turns: int = 8

    def __post_init__(self) -> None:
        require_parts("solver", self.solver, "solver", ("minimise",))
        require_count("n_turns", self.n_turns)

    def minimise(self, problem: Constrained, *, generator: "Generator") -> QuboSolution:
        """Return the answers of all turns, mended, with the number of constraints that each still breaks.

        Energies are those of the objective. A minimum that the solver proves is OPTIMAL here if it breaks nothing;
        if it breaks something although that never pays, it is INFEASIBLE.
        """
        begin = time.perf_counter() - compiling.seconds_spent()
        groups = groups_of(problem)
        posed, penalties = _posed(problem, groups, generator)
        rows, safe = problem.constraints, safe_penalty(posed)
        found, lowest, limit = list[QuboSolution](), np.full(problem.objective.problems, np.inf), limit_here()
        for k in range(self.n_turns):
            given = posed.penalised(as_array(penalties))
            if not getattr(self.solver, "takes_clauses", False):
                given = as_qubo(given)
            try:
                solution = self.solver.minimise(given, generator=generator)  # type: ignore[arg-type]
                raw = solution.assignments[..., : problem.n]
                broken = rows.excess(rows.sums(to_numpy(raw) > 0.5)) > 0
                hopeless = alike(np.any(broken & (penalties >= safe)[..., None, :], axis=-1), raw)
                found.append(_mended(problem, groups, solution, raw, hopeless))
            except KeyboardInterrupt:
                if limit is None or not found:
                    raise
                limit.interrupted = True
            if limit is not None and limit.is_past:
                break
            kept = to_numpy(problem.n_broken(found[-1].best)) == 0
            lowest = np.where(kept, np.minimum(to_numpy(found[-1].best_energy), lowest), lowest)
            # Less energy than the best answer that keeps all constraints: to break some pays.
            pays = to_numpy(solution.energies) < lowest[..., None] - _LEAST * safe
            too_cheap = (broken & pays[..., None]).any(-2) & (penalties < safe)
            enough = np.clip(gains(posed, found[-1].best), penalties / 4, penalties)
            if too_cheap.any():
                dearer = too_cheap | (k >= self.n_turns // 2)
                penalties = np.where(dearer, np.minimum(2 * penalties, safe), penalties)
            elif k == 0 and groups is None and kept.all() and enough.sum() < 0.75 * penalties.sum():
                penalties = enough
            else:
                break
            if k == self.n_turns - 2:
                proves = to_numpy(solution.status == int(Status.OPTIMAL)).all(-1)
                penalties = np.where((np.isinf(lowest) | proves)[..., None], safe, penalties)
        return QuboSolution.joined(found, time.perf_counter() - compiling.seconds_spent() - begin)


def _posed(problem: Constrained, groups: Integers | None, generator: "Generator") -> tuple[Constrained, Numbers]:
    """The problem that the solver is given, and the first penalties, ``(*problems, n_constraints)``."""
    if groups is None or not isinstance(problem.objective, Qubo):
        return problem, local_penalties(problem)
    qubo = problem.objective.floating()
    objective, penalties = shifted(qubo, groups, guides(qubo, groups, generator))
    return Constrained(objective, problem.constraints), to_numpy(penalties)


def _mended(
    problem: Constrained, groups: Integers | None, solution: QuboSolution, raw: Array, hopeless: Array
) -> QuboSolution:
    """The answers of a turn, in the terms of the problem.

    Args:
        problem: The problem.
        groups: Variables of which exactly one is 1, see :func:`groups_of`.
        solution: Answers of the solver.
        raw: Their states of the problem's variables, ``(*problems, n_restarts, n)``.
        hopeless: Whether they break a constraint although that never pays, ``(*problems, n_restarts)``.
    """
    xp, was_run, limit = namespace(raw), solution.energies < namespace(raw).inf, limit_here()
    late = limit is not None and limit.is_past and not problem.objective.problems
    x = xp.asarray(raw, copy=True)
    first = int(solution.energies.argmin()) if late else 0
    chosen = slice(first, first + 1 if late else None)
    x[..., chosen, :] = repair(problem, raw[..., chosen, :])
    if groups is not None and isinstance(problem.objective, Qubo):
        x[..., chosen, :] = descend(problem.objective, groups, x[..., chosen, :])
    broken = xp.where(was_run, problem.n_broken(x), len(problem.constraints))
    energies = xp.where(was_run, problem.energy(x), xp.inf)
    proven = solution.status == int(Status.OPTIMAL)
    # The lowest energy with penalties is no higher than that of any state that keeps all constraints.
    short_of = (problem.n_broken(raw) > 0) & (energies > solution.energies)
    status = xp.where(proven & short_of, int(Status.CONVERGED), solution.status)
    status = xp.where(was_run & (broken > 0), int(Status.NOT_FEASIBLE), status)
    status = xp.where(proven & hopeless, int(Status.INFEASIBLE), status)
    return replace(solution, assignments=x, energies=energies, status=status, broken=broken)


_LEAST = 1e-9
"""Differences of energies that may be rounding errors, as a share of what the objective reaches."""


def safe_penalty(problem: Constrained) -> Numbers:
    """A penalty with which no state that breaks a constraint is a minimum, ``(*problems, 1)``."""
    return _power_of_two_above(_fields(problem).most.sum(-1, keepdims=True))


def local_penalties(problem: Constrained) -> Numbers:
    """What breaking each constraint may gain, seen from its own variables, ``(*problems, n_constraints)``.

    Whoever mends a broken constraint flips one of its variables, which costs the objective its field: about the
    mean over random states and half of the standard deviation. The cheapest flip counts. Where it may break
    another constraint, about a quarter of what flips cost on the average is added.
    """
    rows, fields = problem.constraints, _fields(problem)
    on, off = (np.maximum(sign * fields.mean + fields.deviation / 2, 0) for sign in (1, -1))
    dear = np.maximum(on, off)
    mean = dear.sum(-1, keepdims=True) / np.maximum((dear > 0).sum(-1, keepdims=True), 1)
    extra = _power_of_two_above(mean) / 4
    row, x, rises, filled = rows.row, rows.variables, rows.coefficients > 0, rows.lengths > 0
    from_above = rows.upper < sums_of(np.maximum(rows.coefficients, 0), rows.begins)
    costs = []
    for flip, hurts in ((on, ~rises | from_above[row]), (off, rises | from_above[row])):
        hurts_others = np.bincount(x, hurts, minlength=problem.n)[x] > hurts
        costs.append(flip[..., x] + extra * hurts_others)
    penalties = np.zeros((*problem.objective.problems, len(rows)))
    for sums_rise, of_rows in ((rises, filled), (~rises, filled & from_above)):
        cheapest = np.minimum.reduceat(np.where(sums_rise, *costs), rows.begins[:-1][filled], axis=-1)
        penalties[..., of_rows] = np.maximum(penalties[..., of_rows], cheapest[..., of_rows[filled]])
    return np.minimum(np.where(penalties > 0, penalties, extra), safe_penalty(problem))


def gains(problem: Constrained, x: Array) -> Numbers:
    """How far a flip that breaks each constraint lowers the objective at most, ``(*problems, n_constraints)``.

    Args:
        problem: The problem.
        x: A state that keeps all constraints, ``(*problems, n)``.
    """
    rows, state = problem.constraints, to_numpy(x) > 0.5
    field = to_numpy(double(problem.objective.field(x[..., None, :])))[..., 0, :]
    gain = np.where(state, field, -field).clip(min=0)[..., rows.variables]
    change = np.where(state[..., rows.variables], -rows.coefficients, rows.coefficients)
    breaks = rows.excess(rows.sums(state)[..., rows.row] + change, rows.row) > 0
    found, filled = np.zeros((*problem.objective.problems, len(rows))), rows.lengths > 0
    begins = rows.begins[:-1][filled]
    found[..., filled] = np.maximum.reduceat(np.where(breaks, gain, 0), begins, axis=-1)
    return found


def _power_of_two_above(x: Numbers) -> Numbers:
    """A power of two above a number >= 0, with which sums of whole numbers stay exact."""
    return np.exp2(np.frexp(x)[1])


class _Fields(NamedTuple):
    """Of the objective at x_i = 1 less that at x_i = 0, ``(*problems, n)``: over random states, and its size."""

    mean: Numbers
    deviation: Numbers
    most: Numbers


def _fields(problem: Constrained) -> _Fields:
    """Fields where each variable is 1 half of the time, or as seldom as one of its constraints asks for."""
    objective, rows, n = problem.objective, problem.constraints, problem.n
    most, least = (sums_of(clip(rows.coefficients, 0), rows.begins) for clip in (np.maximum, np.minimum))
    limit = np.where(least == 0, rows.upper / np.maximum(most, 1), 0.5)
    limit = np.where(most == 0, rows.lower / np.minimum(least, -1), limit)
    share = np.full(n, 0.5)
    np.minimum.at(share, rows.variables, limit.clip(0, 0.5)[rows.row])
    short = objective if isinstance(objective, Qubo) else to_qubo(objective.without_longer())
    graph, coupling, linear = short.graph, double(short.coupling), double(short.linear)
    p, q = graph.gather(alike(share, linear))
    mean = linear + graph.scatter(coupling * q, coupling * p)
    variance = graph.scatter(coupling**2 * (q * (1 - q)), coupling**2 * (p * (1 - p)))
    size = abs(linear) + graph.scatter(abs(coupling), abs(coupling))
    for block in () if isinstance(objective, Qubo) else objective.longer:
        weight, variables = double(block.weight)[..., None], block.variables.reshape(-1)
        decisive = 2.0 ** (1 - block.variables.shape[1])  # how often all other literals are false
        spread = decisive * (1 - decisive) * weight
        of_literals = (-decisive * block.polarity, spread * abs(block.polarity), abs(block.polarity))
        each = [(weight * part).reshape(*objective.problems, -1) for part in of_literals]
        mean, variance, size = (
            total + add_up(part, variables, n) for total, part in zip((mean, variance, size), each, strict=True)
        )
    return _Fields(*(to_numpy(part) for part in (mean, variance**0.5, size)))
