"""Compile the kernels before the tests, half of them in each of two processes; what is compiled is kept on disk.

python tests/compile_kernels.py lanes
"""

import sys

import torch

from memcomp_lightning import rng
from memcomp_lightning.likelihood import log_partition_function
from memcomp_lightning.problems import Qubo, from_model
from memcomp_lightning.solvers import BranchAndBound, CrossoverAnnealing, GibbsAnnealing, TabuSearch
from memcomp_lightning.solvers.dmm import BondField, ClauseField, DmmSolver
from memcomp_lightning.testing import small_rbm


def lanes():
    problem, generator = Qubo.from_matrix(torch.ones(2, 2)), rng.stream(0, "compile")
    for field in (ClauseField(), BondField()):
        DmmSolver(field=field, n_restarts=1, max_steps=1).minimise(problem, generator=generator)


def others():
    problem, generator = from_model(small_rbm()), rng.stream(0, "compile")
    DmmSolver(n_restarts=1, max_steps=1).minimise(problem, generator=generator)
    BranchAndBound().minimise(problem, generator=generator)
    for solver in (GibbsAnnealing(n_sweeps=1), TabuSearch(n_steps=1)):
        for each in (problem, Qubo.from_matrix(torch.ones(2, 2))):
            solver.minimise(each, generator=generator)
    CrossoverAnnealing(n_sweeps=1).minimise(Qubo.from_matrix(torch.ones(2, 2)), generator=generator)
    log_partition_function(small_rbm())


PARTS = {part.__name__: part for part in (lanes, others)}

if __name__ == "__main__":
    PARTS[sys.argv[1]]()
