"""QUBO and weighted MAX-SAT: problems, their files, and the exact mappings between them."""

from memcomp_lightning.optional import on_demand
from memcomp_lightning.problems.files.formats import FORMATS
from memcomp_lightning.problems.files.numbers import in_full
from memcomp_lightning.problems.files.objective import Score
from memcomp_lightning.problems.files.source import ProblemFileError
from memcomp_lightning.problems.from_model import from_model
from memcomp_lightning.problems.graph import Bipartite, EdgeList, Graph
from memcomp_lightning.problems.maxsat import Clauses, WeightedMaxSat, from_qubo, to_qubo
from memcomp_lightning.problems.problem import Problem, read_problem
from memcomp_lightning.problems.qubo import Qubo

__all__ = [
    "FORMATS",
    "Bipartite",
    "Clauses",
    "EdgeList",
    "Graph",
    "Problem",
    "ProblemFileError",
    "Qubo",
    "Score",
    "WeightedMaxSat",
    "from_model",
    "from_qubo",
    "in_full",
    "read_problem",
    "to_qubo",
]

__getattr__ = on_demand(__name__, {"from_bqm": "bqm", "to_bqm": "bqm"})
