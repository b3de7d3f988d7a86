"""Solvers of QUBOs behind one contract: exact ones, heuristics, and in ``dmm`` the memcomputing machine."""

from memcomp_lightning.optional import on_demand
from memcomp_lightning.solvers.alternating_descent import AlternatingDescent
from memcomp_lightning.solvers.annealing import GibbsAnnealing
from memcomp_lightning.solvers.answer import Answer, write_solution
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver, RecordedStates, Status
from memcomp_lightning.solvers.best import Portfolio
from memcomp_lightning.solvers.branch_and_bound import BranchAndBound
from memcomp_lightning.solvers.brute_force import BruteForce
from memcomp_lightning.solvers.constrained import PenaltyLoop
from memcomp_lightning.solvers.crossover import CrossoverAnnealing
from memcomp_lightning.solvers.found import Found, State
from memcomp_lightning.solvers.search import Search
from memcomp_lightning.solvers.tabu import TabuSearch

__all__ = [
    "AlternatingDescent",
    "Answer",
    "BranchAndBound",
    "BruteForce",
    "CrossoverAnnealing",
    "Found",
    "GibbsAnnealing",
    "PenaltyLoop",
    "Portfolio",
    "QuboSolution",
    "QuboSolver",
    "RecordedStates",
    "Search",
    "State",
    "Status",
    "TabuSearch",
    "write_solution",
]

__getattr__ = on_demand(__name__, {"DimodSolver": "dimod"})
