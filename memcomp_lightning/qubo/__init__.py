"""QUBO and weighted MAX-SAT: problems and their files, exact mappings between them, simple solvers."""

from memcomp_lightning.qubo.alternating_descent import AlternatingDescent
from memcomp_lightning.qubo.annealing import GibbsAnnealing
from memcomp_lightning.qubo.branch_and_bound import BranchAndBound
from memcomp_lightning.qubo.brute_force import BruteForce
from memcomp_lightning.qubo.files.formats import FORMATS
from memcomp_lightning.qubo.files.numbers import in_full
from memcomp_lightning.qubo.files.objective import Score
from memcomp_lightning.qubo.files.source import ProblemFileError
from memcomp_lightning.qubo.from_model import from_model
from memcomp_lightning.qubo.graph import Bipartite, EdgeList, Graph
from memcomp_lightning.qubo.io import Answer, Problem, read_problem, write_solution
from memcomp_lightning.qubo.maxsat import Clauses, WeightedMaxSat, from_qubo, to_qubo
from memcomp_lightning.qubo.qubo import Qubo, QuboSolution, QuboSolver, Status, Trajectory

__all__ = [
    "FORMATS",
    "AlternatingDescent",
    "Answer",
    "Bipartite",
    "BranchAndBound",
    "BruteForce",
    "Clauses",
    "EdgeList",
    "GibbsAnnealing",
    "Graph",
    "Problem",
    "ProblemFileError",
    "Qubo",
    "QuboSolution",
    "QuboSolver",
    "Score",
    "Status",
    "Trajectory",
    "WeightedMaxSat",
    "from_model",
    "from_qubo",
    "in_full",
    "read_problem",
    "to_qubo",
    "write_solution",
]
