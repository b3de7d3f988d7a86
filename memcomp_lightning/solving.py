"""Solve a problem in one line."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.errors import require, require_choice, require_count, require_parts
from memcomp_lightning.problems.files.numbers import Exact
from memcomp_lightning.problems.labelled import Labelled
from memcomp_lightning.problems.problem import Problem
from memcomp_lightning.solvers.answer import Answer
from memcomp_lightning.solvers.base import QuboSolver, Status
from memcomp_lightning.solvers.found import State
from memcomp_lightning.solvers.search import Search
from memcomp_lightning.solvers.solving import check_memory

SOLVERS = {
    "best": "best.Portfolio",
    "annealing": "annealing.GibbsAnnealing",
    "tabu": "tabu.TabuSearch",
    "crossover": "crossover.CrossoverAnnealing",
    "dmm": "dmm.DmmSolver",
    "alternating_descent": "alternating_descent.AlternatingDescent",
    "brute_force": "brute_force.BruteForce",
    "branch_and_bound": "branch_and_bound.BranchAndBound",
}
"""Solvers that a name stands for, with their defaults."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False, repr=False)
class Solution:
    """What :func:`solve` found.

    Attributes:
        best: The state of lowest energy: a dict of values by label where the problem has labels, else an array.
        best_energy: Its energy; of a cut minus its weight. Exact for a file, whose ``objective`` may be minus it.
            Whole numbers whose sums float64 would round are added up as integers of 64 bits.
        energies: Energy of each restart, ``(n_restarts,)``; NaN where not run.
        status: What is known of the best energy, with ``status.advice``: OPTIMAL is proven.
        n_reached: Number of restarts that end at the best energy.
        lower_bound: No state has a lower energy; minus infinity where none is known.
        solutions: Distinct states as ``values``, ``energy`` and ``seconds``, the best first.
        curve: Seconds and energy of each better state, as they came.
        wall_time_s: Seconds in all, those of compilation not counted.
        answer: The same in the terms of a problem's file; None where there is none.
    """

    best: Any
    best_energy: Exact | float
    energies: NDArray[np.float64]
    status: Status
    n_reached: int
    lower_bound: float
    solutions: list[State]
    curve: list[tuple[float, Exact | float]]
    wall_time_s: float
    answer: Answer | None

    def __repr__(self) -> str:
        """Energy and status; states may be long."""
        reached = f"reached by {self.n_reached} of {np.isfinite(self.energies).sum()} restarts"
        return f"<Solution: energy {self.best_energy} {self.status.name}, {reached}, {self.wall_time_s:.3g} s>"


def solve(
    problem: Any,
    *,
    solver: str | QuboSolver = "best",
    seed: int = 0,
    time_limit: float | None = None,
    target: float | None = None,
    initial: Any = None,
    n_solutions: int = 1,
    min_distance: int = 1,
    callback: Callable[[State], object] | None = None,
) -> Solution:
    """Look for the state of lowest energy.

    Ctrl-C returns the best so far. Restarts are shared by as many threads as ``OMP_NUM_THREADS`` says, or torch
    uses where it is loaded; without either by one thread a processor.

    Args:
        problem: A square matrix Q of numpy, scipy.sparse or torch, or a dict ``{(i, j): q}``: minimise x'Qx over x
            in {0, 1}. A pair ``(h, J)``: h . s + sum J_ij s_i s_j over spins s in {-1, 1}. A model of dimod,
            with constraints or without. A networkx graph: its largest cut, by the edges' ``weight``. An RBM: its
            ground state (v, h). The path of a file that ``memcomp-solve`` reads, or what ``read_problem`` returns.
            A ``Qubo``, ``WeightedMaxSat`` or ``Constrained``.
        solver: A key of :data:`SOLVERS`, or a solver with settings, such as ``TabuSearch(n_restarts=100)``.
        seed: Of the random stream. The same seed gives the same answer, if there is no time limit.
        time_limit: Seconds, > 0, those of compilation not counted; None is one call of the solver. Annealing,
            crossover and tabu search end in time; other solvers end the round that they are in.
        target: Stop at this energy or below; of a cut or a file, at this objective or better. Without a time limit
            the search goes on until then.
        initial: A state, or a list of states, to begin with, written as ``best`` is.
        n_solutions: Most distinct states to return, >= 1.
        min_distance: Number of variables in which any two of them differ at least, >= 1.
        callback: Called with each better state: its ``values``, ``energy`` and ``seconds``.

    Raises:
        SettingError, UserError, ProblemFileError: The problem or a setting is not allowed, or memory is short.

    >>> solve({("a", "a"): 1, ("a", "b"): -3, ("b", "b"): 1}).best
    {'a': 1, 'b': 1}
    """
    require_count("seed", seed, 0)
    require(callback is None or callable(callback), "callback", callback, "a function of a state, or None")
    labelled, chosen = Labelled.of(problem), solver_of(solver)
    search = Search(
        time_limit=time_limit,
        target=-target if target is not None and labelled.maximised else target,
        n_solutions=n_solutions,
        min_distance=min_distance,
    )
    check_memory(labelled.problem, chosen)

    def written(state: State) -> State:
        return state._replace(values=labelled.written(state.values))

    found = search.run(
        labelled.problem,
        chosen,
        seed=seed,
        initial=None if initial is None else labelled.read(initial),
        callback=None if callback is None else lambda state: callback(written(state)),
    )
    solutions = [written(state) for state in found.states]
    return Solution(
        best=solutions[0].values,
        best_energy=solutions[0].energy,
        energies=np.array([math.nan if energy is None else float(energy) for energy in found.energies]),
        status=found.conclusion,
        n_reached=found.n_reached,
        lower_bound=found.lower_bound,
        solutions=solutions,
        curve=found.curve,
        wall_time_s=found.wall_time_s,
        answer=Answer.of(labelled.problem, found) if isinstance(labelled.problem, Problem) else None,
    )


def solver_of(solver: str | QuboSolver) -> QuboSolver:
    """The solver that a name stands for, or itself."""
    if isinstance(solver, str):
        require_choice("solver", solver, SOLVERS)
        module, _, name = SOLVERS[solver].partition(".")
        made: QuboSolver = getattr(import_module(f"memcomp_lightning.solvers.{module}"), name)()
        return made
    require_parts("solver", solver, "solver", ("minimise",))
    return solver
