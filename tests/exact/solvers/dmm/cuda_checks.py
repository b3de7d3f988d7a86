"""The DMM's CUDA kernel against the CPU's, on a device or, as a program of its own, in numba's simulator.

The simulator must be chosen before numba is imported: NUMBA_ENABLE_CUDASIM=1 python cuda_checks.py
"""

import dataclasses
import sys

import numpy as np
import pytest
from numba import config

from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Bipartite, Qubo, WeightedMaxSat
from memcomp_lightning.solvers.dmm import (
    BondField,
    ClauseField,
    DmmSolver,
    Heun,
    Recording,
    Splitting,
    WarmRestart,
)
from memcomp_lightning.solvers.dmm.kernels import cpu, cuda
from memcomp_lightning.solvers.dmm.kernels.run import Stall, Start
from memcomp_lightning.solvers.dmm.solver import _flatten

DRAW = np.random.default_rng(0)
SLOW = Splitting(change=0.3, dt_min=0.01, dt_max=0.4, lag=0.2)
FIELDS = {
    "clauses": ClauseField(
        alpha=2.0, beta=1.5, gamma=0.25, delta=0.1, long_term_max=3.0, noise=0.2, integrator=SLOW
    ),
    "bonds": BondField(alpha=1.5, beta=2.0, gamma=2.5, delta=4.0, zeta=1.0, long_term_max=2.0, integrator=SLOW),
}
CLAUSES = [[1, 2], [-1, 3], [-2, -3], [4, -5], [5], [-4, 1], [2, -5]]
PROBLEMS = {
    "layers": Qubo(Bipartite(4, 3), DRAW.normal(size=(2, 3, 4)), DRAW.normal(size=(2, 7)), np.zeros(2)),
    "pairs": Qubo.from_matrix(DRAW.normal(size=(1, 6, 6)), np.zeros(1)),
    "clauses": _flatten(WeightedMaxSat.from_clauses(5, CLAUSES, DRAW.uniform(0.5, 2.0, size=7))),
}
CASES = [(kind, name) for kind in FIELDS for name in PROBLEMS if kind == "clauses" or name != "clauses"]


class Other(ClauseField):
    """May change any equation."""


def runs(field, problem, kept=False, **settings):
    """Of the kernels for CPU and device from one start."""
    draw = np.random.default_rng(1)
    shape = (len(problem.offset), 2, problem.n)
    voltage = draw.uniform(-0.9, 0.9, size=shape)
    sizes = [problem.graph.edge_shape, (problem.n,)] if kept else []
    memories = tuple(draw.uniform(0, 1, size=(*shape[:2], *size)) for size in sizes)
    start = Start(voltage, memories, draw.integers(2**32, size=shape[:2]))
    return [kernel.run(field, field.integrator, problem, start, **settings) for kernel in (cpu, cuda)]


def alike(here, there, tolerance):
    np.testing.assert_allclose(there.voltage, here.voltage, atol=tolerance, rtol=0)
    for ours, theirs in zip(here.kept, there.kept, strict=False):
        np.testing.assert_allclose(theirs, ours, atol=tolerance, rtol=0)
    for name in ("best", "found_at", "steps"):
        np.testing.assert_array_equal(getattr(there, name), getattr(here, name))
    assert (there.visited is None) == (here.visited is None)
    if here.visited is not None:
        np.testing.assert_allclose(there.visited.time, here.visited.time, rtol=tolerance)
        np.testing.assert_array_equal(there.visited.states, here.visited.states)


def check_trajectories(kind, name, tolerance):
    """With noise, kept memories, descents and records; and without noise."""
    field, problem = FIELDS[kind], PROBLEMS[name]
    settings = {"n_steps": 6, "stall": None, "quench_every": 2}
    here, there = runs(field, problem, kept=True, recording=Recording(every=1), **settings)
    alike(here, there, tolerance)
    assert len(there.kept) == 2
    assert (there.visited.states[:, :, 0] != there.visited.states[:, :, -1]).any(), "nothing moves"
    silent = runs(dataclasses.replace(field, noise=0.0), problem, kept=True, recording=None, **settings)
    alike(*silent, tolerance)
    assert abs(silent[1].voltage - there.voltage).max() > 0.01, "there is no noise"


def check_ends(tolerance):
    """Restarts that stall, and memories that are not asked for."""
    field, problem = FIELDS["clauses"], PROBLEMS["pairs"]
    for quench_every in (0, 1):
        stalls = runs(field, problem, n_steps=7, quench_every=quench_every, recording=None, stall=Stall(1, 1.0))
        alike(*stalls, tolerance)
        assert stalls[1].steps.min() < 7, "nothing stalls"
    assert runs(field, problem, n_steps=1, quench_every=0, recording=None, remember=False)[1].kept == ()


def check_solver():
    """The same answers by either kernel, in groups of restarts that go on from earlier ones; and refusals."""
    settings = {"n_restarts": 4, "patience": 2, "max_steps": 3, "warm": WarmRestart()}
    for problem in (PROBLEMS["layers"], Qubo.from_matrix(np.diag([1.0, -2.0]))):  # the second has no pairs
        compiled, ours = (
            DmmSolver(kernel=kernel, **settings).minimise(problem, generator=np.random.default_rng(2))
            for kernel in ("compiled", "cuda")
        )
        np.testing.assert_array_equal(ours.assignments, compiled.assignments)
    for part, wrong in {
        "Other has no CUDA kernel": {"field": Other()},
        "Heun has no CUDA kernel": {"integrator": Heun()},
        "zeta = 1 has no compiled kernel": {"field": ClauseField(zeta=1.0)},
    }.items():
        with pytest.raises(SettingError, match=part):
            DmmSolver(kernel="cuda", **wrong)
    longer, solver = WeightedMaxSat.from_clauses(3, [[1, 2, 3]], [1.0]), DmmSolver(kernel="cuda")
    with pytest.raises(SettingError, match="longest clause = 3"):
        solver.minimise(longer, generator=np.random.default_rng(0))


if __name__ == "__main__":
    assert config.ENABLE_CUDASIM
    sys.setswitchinterval(1e-5)  # the simulator's threads wait for each other in turn
    for case in CASES:
        check_trajectories(*case, tolerance=1e-5)
    check_ends(tolerance=1e-5)
    check_solver()
    print("alike")
