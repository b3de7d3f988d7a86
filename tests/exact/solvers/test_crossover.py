"""Partition crossover: the child is the best of all that inherit each part from one of both parents."""

import itertools
import time

import networkx
import numpy as np
import pytest

from memcomp_lightning.problems import Qubo
from memcomp_lightning.rng import numpy_stream
from memcomp_lightning.solvers import CrossoverAnnealing, GibbsAnnealing, Status, TabuSearch
from memcomp_lightning.solvers import crossover as plain
from memcomp_lightning.solvers.compiled import float32, limited, seen_from_variables
from memcomp_lightning.solvers.kernels import annealing
from memcomp_lightning.solvers.kernels import crossover as compiled


def sparse_problem(n, seed):
    """A random graph of about two neighbours a variable."""
    generator = numpy_stream(seed, "sparse")
    rows, columns = generator.integers(n, size=(2, n))
    values = generator.integers(-8, 9, 2 * n).astype(float)
    everyone = np.arange(n)
    return Qubo.from_coo(n, np.concatenate((rows, everyone)), np.concatenate((columns, everyone)), values)


def lowest_child(qubo, x, other):
    """By the energies of all ways to inherit the connected parts."""
    differs = np.flatnonzero(x != other)
    graph = networkx.Graph(qubo.graph.edges().tolist())
    graph.add_nodes_from(range(qubo.n))
    parts = [list(part) for part in networkx.connected_components(graph.subgraph(differs.tolist()))]
    children = []
    for taken in itertools.product((False, True), repeat=len(parts)):
        child = x.copy()
        for part in itertools.compress(parts, taken):
            child[part] = other[part]
        children.append(child)
    return qubo.energy(np.array(children)).min(), len(parts)


def crossed_by_kernel(qubo, x, other):
    """The children of ``LANES`` pairs of states, and how far the kept fields are off."""
    problem = seen_from_variables(qubo)
    pairs = (problem.begins, problem.variables, float32(problem.couplings[0]))
    lanes = [float32(part.T) for part in (x, qubo.field(x), other, qubo.field(other))]
    compiled._cross(*lanes, pairs, np.zeros(qubo.n, np.bool_), np.zeros(qubo.n, np.int64))
    child = lanes[0].T
    return child, np.abs(qubo.field(child) - lanes[1].T).max()


@pytest.mark.parametrize("seed", range(5))
def test_the_child_is_the_best_of_all(seed):
    qubo = sparse_problem(24, seed)
    parents = numpy_stream(seed, "parents").integers(0, 2, (2, annealing.LANES, qubo.n)).astype(float)
    best, n_parts = zip(*(lowest_child(qubo, *pair) for pair in zip(*parents, strict=True)), strict=True)
    assert min(n_parts) > 1
    child, off = crossed_by_kernel(qubo, *parents)
    assert off == 0
    assert qubo.energy(child).tolist() == list(best)
    assert qubo.energy(plain._cross(qubo, *parents)).tolist() == list(best)


def test_regions_that_are_not_coupled_are_solved_each_by_itself():
    """Fifty copies of one small problem: one restart finds all the minima at once, which chance would not."""
    one, n_copies = sparse_problem(12, 7).to_matrix(), 50
    states = np.array(list(itertools.product((0.0, 1.0), repeat=12)))
    lowest = Qubo.from_matrix(one).energy(states).min()
    qubo = Qubo.from_matrix(np.kron(np.eye(n_copies), one))
    found = CrossoverAnnealing(n_restarts=1, n_sweeps=20, n_rounds=20).minimise(
        qubo, generator=numpy_stream(0, "x")
    )
    assert found.best_energy == n_copies * lowest


@pytest.mark.parametrize(
    "solver",
    [
        CrossoverAnnealing(n_sweeps=10**6),
        GibbsAnnealing(n_sweeps=10**7),
        TabuSearch(n_steps=2**29 - 1),
    ],
    ids=lambda solver: type(solver).__name__,
)
def test_a_search_within_a_limit_ends_in_time_with_what_it_found(solver):
    qubo = sparse_problem(200, 0)
    begin = time.perf_counter()
    with limited(begin + 0.2) as limit:
        solution = solver.minimise(qubo, generator=numpy_stream(0, "x"))
    assert time.perf_counter() - begin < 10
    assert not limit.interrupted
    assert set(solution.status.tolist()) <= {Status.STOPPED, Status.NOT_RUN}
    was_run = solution.status == Status.STOPPED
    assert was_run.any()
    assert np.array_equal(np.isfinite(solution.energies), was_run)
    some = GibbsAnnealing(n_sweeps=1).minimise(qubo, generator=numpy_stream(0, "x"))
    assert solution.best_energy <= some.energies.mean()
