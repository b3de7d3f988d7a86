"""Minima and bounds that cost little, against all energies."""

import sys

import numpy as np
import pytest

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.problems import EdgeList, Qubo
from memcomp_lightning.solvers import proofs
from memcomp_lightning.solvers.proofs import eliminated, roof_dual

N = 11


def pairs_of_treewidth(width, generator):
    """Each new variable meets ``width`` that meet each other: no graph of this treewidth has more pairs."""
    cliques, pairs = [list(range(width))], [(i, j) for i in range(width) for j in range(i)]
    for new in range(width, N):
        clique = cliques[generator.integers(len(cliques))]
        pairs += [(old, new) for old in clique]
        cliques += [[new, *clique[:k], *clique[k + 1 :]] for k in range(len(clique))]
    order = generator.permutation(N)
    return [(int(order[i]), int(order[j])) for i, j in pairs]


def problem(pairs, generator, integers=False):
    numbers = generator.normal(size=len(pairs) + N)
    numbers = np.rint(3 * numbers).astype(np.int64) if integers else numbers
    rows, columns = np.array([*pairs, *((i, i) for i in range(N))]).T
    return Qubo.from_coo(N, rows, columns, numbers, np.array(2, numbers.dtype))


def lowest(qubo):
    return qubo.energy(binary_states(N, like=qubo.linear)).min()


SPARSE = {
    "nothing": lambda generator: [],
    "tree": lambda generator: pairs_of_treewidth(1, generator),
    "two trees": lambda generator: [pair for pair in pairs_of_treewidth(1, generator) if 0 not in pair],
    "ring": lambda generator: [(i, (i + 1) % N) for i in range(N)],
    "ladder": lambda generator: [(i, i + 1) for i in range(N - 1)] + [(i, i + 2) for i in range(N - 2)],
    "treewidth two": lambda generator: pairs_of_treewidth(2, generator),
}


@pytest.mark.parametrize("integers", [False, True])
@pytest.mark.parametrize("name", SPARSE)
def test_what_comes_apart_is_solved(name, integers):
    generator = rng.numpy_stream(0, name)
    for _ in range(20):
        qubo = problem(SPARSE[name](generator), generator, integers)
        found = qubo.energy(eliminated(qubo)[None].astype(qubo.linear.dtype)).item()
        assert found == pytest.approx(lowest(qubo), abs=0 if integers else 1e-12)


def test_what_does_not_come_apart_is_left_alone():
    generator = rng.numpy_stream(0, "dense")
    assert eliminated(problem(pairs_of_treewidth(3, generator), generator)) is None
    complete = [(i, j) for i in range(4) for j in range(i)]  # few pairs, but four variables that all meet
    assert eliminated(problem(complete, generator)) is None


def test_pairs_that_are_listed_twice_add_up():
    twice = EdgeList(n=3, pairs=np.array([[0, 1], [0, 1], [1, 2]]))
    qubo = Qubo(twice, np.array([5.0, -4.0, -1.5]), np.array([-2.0, 0.5, 0.0]), np.array(0.0))
    lowest = qubo.energy(binary_states(3, like=qubo.linear)).min()
    assert qubo.energy(eliminated(qubo)[None].astype(float)) == lowest


def test_integers_beyond_float64_are_not_rounded():
    """float64 holds neither 2^60 + 1 nor the difference of the two best energies."""
    qubo = Qubo.from_coo(
        3, np.array([0, 0, 1, 2]), np.array([0, 1, 2, 2]), np.array([2**60 + 1, -(2**60) - 4, 2**59, -1])
    )
    states = binary_states(3, like=np.zeros(0)).astype(np.int64)
    assert qubo.energy(eliminated(qubo)[None].astype(np.int64)) == qubo.energy(states).min() == -3


def test_the_roof_dual_bounds_and_decides():
    pytest.importorskip("dwave.preprocessing")
    generator, n_decided, n_open = rng.numpy_stream(0, "roof"), 0, 0
    for k in range(60):
        qubo = problem(pairs_of_treewidth(1 + k % 5, generator), generator)
        dual, minimum = roof_dual(qubo), lowest(qubo)
        assert dual.lower_bound <= minimum
        if dual.minimum is None:
            n_open += 1
            continue
        n_decided += 1
        assert qubo.energy(dual.minimum[None].astype(float)).item() == pytest.approx(minimum, abs=1e-12)
        assert dual.lower_bound == pytest.approx(minimum, abs=1e-9)
    assert n_decided
    assert n_open


def test_a_state_that_does_not_meet_the_bound_is_no_minimum(monkeypatch):
    """dwave-preprocessing may fix all variables to values that are each part of a minimum, but not of the same."""
    preprocessing = pytest.importorskip("dwave.preprocessing")
    monkeypatch.setattr(preprocessing, "roof_duality", lambda bqm, strict: (-1.0, {0: 0, 1: 0}))
    dual = roof_dual(Qubo.from_matrix(np.array([[-1.0, 2.0], [0.0, -1.0]])))
    assert dual.lower_bound == pytest.approx(-1.0)
    assert dual.minimum is None


def test_without_its_package_or_of_many_couplings_there_is_no_roof_dual(monkeypatch):
    generator = rng.numpy_stream(0, "roof")
    qubo = problem(pairs_of_treewidth(2, generator), generator)
    with monkeypatch.context() as patch:
        patch.setattr(proofs, "MOST_PAIRS", 5)
        assert roof_dual(qubo) is None
    monkeypatch.setitem(sys.modules, "dwave.preprocessing", None)
    assert roof_dual(qubo) is None
