"""Weighted partial MAX-SAT with structure, against the minimum that RC2 of python-sat proves."""

import random
import sys
from pathlib import Path

import pytest

from memcomp_lightning import rng
from memcomp_lightning.solvers import PenaltyLoop, Portfolio
from memcomp_lightning.solvers.dmm import DmmSolver

pytest.importorskip("pysat")
sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "hard_clauses"))

import structured
from pysat.examples.rc2 import RC2

FAMILIES = {
    structured.vertex_cover: (60, 120),
    structured.colouring: (14, 30),
    structured.scheduling: (8, 4, 12),
    structured.random_clauses: (24, 60, 48),
    structured.potts: (12, 28),
    structured.k_of_n: (12, 4),
}
SOLVERS = {
    "best": Portfolio(n_restarts=112, effort=4.0),
    "dmm": DmmSolver(n_restarts=60, max_steps=600, stall=None),
}


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_the_minimum_is_found(family, solver):
    for seed in range(3):
        instance = family(random.Random(seed), *FAMILIES[family])
        with RC2(instance.formula()) as prover:
            assert prover.compute() is not None
            lowest = prover.cost
        problem = instance.problem()
        loop = PenaltyLoop(solver=SOLVERS[solver])
        solution = loop.minimise(problem, generator=rng.numpy_stream(seed, "solver"))
        assert int(solution.broken.min()) == 0
        assert float(solution.best_energy) == lowest
