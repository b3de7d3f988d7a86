"""The portfolio: each kind of problem takes another way, and finds the minimum."""

import numpy as np
import pytest
import torch

from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Bipartite, Qubo
from memcomp_lightning.rng import numpy_stream
from memcomp_lightning.solvers import BranchAndBound, BruteForce, Portfolio, Status, TabuSearch


def layers(generator):
    """Two full layers, too large to be enumerated at once."""
    return Qubo(Bipartite(20, 15), generator.normal(size=(15, 20)), generator.normal(size=35), np.zeros(()))


def dense(generator):
    """All pairs coupled."""
    return Qubo.from_matrix(generator.normal(size=(18, 18)))


def sparse(generator):
    """Two neighbours a variable."""
    rows, columns = generator.integers(18, size=(2, 18))
    return Qubo.from_coo(18, rows, columns, generator.normal(size=18))


@pytest.mark.parametrize("n_restarts", [1, 2, 5, 28])
@pytest.mark.parametrize(
    ("make", "prover"), [(layers, BranchAndBound()), (dense, BruteForce()), (sparse, BruteForce())]
)
def test_each_kind_of_problem_is_solved(make, prover, n_restarts):
    qubo = make(numpy_stream(3, "portfolio"))
    minimum = prover.minimise(qubo, generator=numpy_stream(0, "proof")).best_energy
    solver = Portfolio(n_restarts=n_restarts)
    ours, again, theirs = (
        solver.minimise(given, generator=numpy_stream(1, "solver"))
        for given in (qubo, qubo, qubo.alike(torch.zeros((), dtype=torch.float64)))
    )
    assert ours.best_energy == pytest.approx(minimum.item(), abs=1e-12)
    assert ours.energies.shape == (n_restarts,)
    assert not (ours.status == Status.NOT_RUN).any()
    assert np.array_equal(ours.assignments, again.assignments)
    assert np.array_equal(ours.assignments, theirs.assignments.numpy())
    if ours.population is not None:
        assert ours.population.shape == (n_restarts,)
        assert np.array_equal(ours.population, theirs.population.numpy())


def test_populations_of_trials_and_of_the_rest_differ():
    """Sixteen states of a population are not independent; those of tabu search are."""
    found = Portfolio().minimise(dense(numpy_stream(3, "portfolio")), generator=numpy_stream(1, "solver"))
    sizes = np.unique(found.population, return_counts=True)[1]
    assert sizes.sum() == 28
    assert sizes.max() <= 14
    assert (sizes == 1).sum() >= 3


def test_whole_numbers_in_two_layers_are_solved():
    numbers = numpy_stream(0, "whole").integers(-9, 10, (20, 5))
    whole = Qubo(Bipartite(5, 20), numbers, np.arange(25) - 12, np.array(0))
    minimum = BranchAndBound().minimise(whole.double(), generator=numpy_stream(0, "proof")).best_energy
    assert Portfolio().minimise(whole, generator=numpy_stream(0, "solver")).best_energy == minimum


@pytest.mark.parametrize("name", ["n_steps", "tenure", "patience"])
def test_more_than_the_kernel_counts_is_refused(name):
    with pytest.raises(SettingError, match=f"{name} = {2**30}"):
        TabuSearch(**{name: 2**30})
