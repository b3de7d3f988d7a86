"""Hand a problem to a solver in the form that it takes, and refuse what memory cannot hold."""

import math
import os
from typing import TYPE_CHECKING

from memcomp_lightning.errors import UserError, require
from memcomp_lightning.problems import Bipartite, Constrained, Problem, Qubo, WeightedMaxSat, as_qubo
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver
from memcomp_lightning.solvers.branch_and_bound import BranchAndBound
from memcomp_lightning.solvers.brute_force import BruteForce
from memcomp_lightning.solvers.constrained import PenaltyLoop
from memcomp_lightning.solvers.dmm import DmmSolver, default_steps

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator

Given = Problem | Constrained | Qubo | WeightedMaxSat
"""One problem, from a file or not."""

MOST_RECORDED = 4 * 2**30
"""Bytes of a trajectory that a common computer's memory holds."""


def minimise(problem: Given, solver: QuboSolver, generator: "Generator") -> QuboSolution:
    """The solver's answer, with penalties for constraints as they need them where it proves nothing.

    Without variables there is one state, and no solver has to look for it.
    """
    given, constrained = numbers_of(problem), constrained_of(problem)
    if given.n == 0:
        return BruteForce().minimise(as_qubo(given), generator=generator)
    try:
        proves = isinstance(solver, BruteForce) and isinstance(problem, Problem)
        if proves and isinstance(problem, Problem) and problem.integers is not None and not problem.resolved:
            return solver.minimise(problem.integers, generator=generator)
        if constrained is not None and not proves:
            return PenaltyLoop(solver=solver).minimise(constrained, generator=generator)
        if getattr(solver, "takes_clauses", False):
            return solver.minimise(given, generator=generator)  # type: ignore[arg-type]
        if isinstance(given, WeightedMaxSat) and given.longer:
            return PenaltyLoop(solver=solver).minimise(Constrained.of(given, []), generator=generator)
        return solver.minimise(as_qubo(given), generator=generator)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or "memory" in str(error):
            raise UserError(_too_large(problem, solver)) from error
        raise


def numbers_of(problem: Given) -> Qubo | WeightedMaxSat:
    """What is minimised of it; of a file with hard clauses their penalties, too."""
    if isinstance(problem, Constrained):
        return problem.objective
    return problem.problem if isinstance(problem, Problem) else problem


def constrained_of(problem: Given) -> Constrained | None:
    """The problem with its constraints apart; None without any."""
    if isinstance(problem, Problem):
        return problem.constrained
    return problem if isinstance(problem, Constrained) else None


def check_memory(problem: Given, solver: QuboSolver) -> None:
    """Refuse, before anything is solved, a trajectory or states of restarts that memory could not hold."""
    given = numbers_of(problem)
    if isinstance(solver, DmmSolver) and solver.record is not None:
        n_bytes = solver.n_restarts * (solver.max_steps or default_steps(given)) * given.n
        every, remedy = solver.record.every, "To record nothing, use solver=dmm."
        least, gib = 1 + n_bytes // MOST_RECORDED, MOST_RECORDED // 2**30
        allowed = f"at least {least}, for a trajectory of at most {gib} GiB"
        require(n_bytes // every <= MOST_RECORDED, "solver.record.every", every, allowed, remedy)
    if memory_needed(given, solver) > _installed():
        raise UserError(_too_large(problem, solver))
    constrained = constrained_of(problem)
    if constrained is not None and not constrained.constraints.are_clauses:
        lengths = constrained.constraints.lengths
        n_pairs = int((lengths * (lengths - 1) // 2).sum())
        if _BYTES_A_PAIR * n_pairs > _installed():
            needed, installed = (f"{size / 2**30:.0f} GiB" for size in (_BYTES_A_PAIR * n_pairs, _installed()))
            raise UserError(
                f"Constraints of up to {lengths.max()} variables couple {n_pairs} pairs, which need about "
                f"{needed} of memory, more than there is ({installed}): write them with fewer variables each."
            )


def memory_needed(problem: Qubo | WeightedMaxSat, solver: QuboSolver) -> int:
    """About the bytes that a solver works with: a few numbers a variable and a coupling, each restart."""
    if isinstance(solver, (BruteForce, BranchAndBound)):
        return 0
    longer = () if isinstance(problem, Qubo) else problem.longer
    pairs = 0 if isinstance(problem.graph, Bipartite) else math.prod(problem.graph.edge_shape)
    numbers = problem.n + pairs + sum(math.prod(block.variables.shape) for block in longer)
    return _NUMBERS_EACH * 8 * int(getattr(solver, "n_restarts", 1)) * numbers


_BYTES_A_PAIR = 100
"""Of a QUBO that is put together from the squares of sums."""

_NUMBERS_EACH = 5
"""Of eight bytes, for a variable or a coupling of a restart; measured."""


def _installed() -> float:
    """Bytes of memory of this computer; infinite where it does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return math.inf


def _too_large(problem: Given, solver: QuboSolver) -> str:
    """Why the solver does not fit, and what to do."""
    given = numbers_of(problem)
    whose, counts = "", {"variables": given.n, "couplings": math.prod(given.graph.edge_shape)}
    if isinstance(problem, Problem):
        whose, counts = f"{problem.path}: ", problem.sizes
    sizes = ", ".join(f"{number} {kind.replace('_', ' ')}" for kind, number in counts.items())
    restarts = getattr(solver, "n_restarts", None)
    each = "" if restarts is None else f" with solver.n_restarts = {restarts}"
    remedy = "a smaller problem" if restarts in (None, 1) else "fewer restarts, as solver.n_restarts=1"
    sizes_in_bytes = memory_needed(given, solver), _installed()
    needed, installed = (f"{n_bytes / 2**30:.0f} GiB" for n_bytes in sizes_in_bytes)
    return (
        f"{whose}{sizes}. {type(solver).__name__}{each} needs about {needed} of memory, "
        f"more than there is ({installed}): try {remedy}."
    )
