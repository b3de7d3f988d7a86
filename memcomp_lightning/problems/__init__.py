"""QUBO and weighted MAX-SAT, with constraints or without: problems, their files, exact mappings between them."""

from memcomp_lightning.optional import on_demand
from memcomp_lightning.problems.constrained import Constrained, Linear, clause, exactly
from memcomp_lightning.problems.files.formats import FORMATS
from memcomp_lightning.problems.files.numbers import in_full
from memcomp_lightning.problems.files.objective import Score
from memcomp_lightning.problems.files.source import ProblemFileError
from memcomp_lightning.problems.from_model import constrained_from_model, from_model
from memcomp_lightning.problems.graph import Bipartite, EdgeList, Graph
from memcomp_lightning.problems.maxsat import Clauses, WeightedMaxSat, as_qubo, from_qubo, to_qubo
from memcomp_lightning.problems.problem import Problem, is_problem_file, read_problem
from memcomp_lightning.problems.qubo import Qubo

__all__ = [
    "FORMATS",
    "Bipartite",
    "Clauses",
    "Constrained",
    "EdgeList",
    "Graph",
    "Linear",
    "Problem",
    "ProblemFileError",
    "Qubo",
    "Score",
    "WeightedMaxSat",
    "as_qubo",
    "clause",
    "constrained_from_model",
    "exactly",
    "from_model",
    "from_qubo",
    "in_full",
    "is_problem_file",
    "read_problem",
    "to_qubo",
]

__getattr__ = on_demand(__name__, {"from_bqm": "bqm", "from_cqm": "cqm", "to_bqm": "bqm"})
