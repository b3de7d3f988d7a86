"""Brute force and descent against all energies."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models.enumeration import binary_states
from memcomp_lightning.qubo import AlternatingDescent, BruteForce, Qubo, Status, from_model
from memcomp_lightning.testing.conformance import small_rbm


def matrix(*shape):
    return torch.empty(shape, dtype=torch.float64).normal_(generator=rng.stream(0, "test draws"))


PROBLEMS = {
    "model 7 x 5": from_model(small_rbm(7, 5).double()),
    "models 5 x 7": from_model(small_rbm(5, 7, replicas=(2, 3)).double()),
    "dense": Qubo.from_matrix(matrix(11, 11), matrix()),
    "batch of dense": Qubo.from_matrix(matrix(2, 3, 7, 7), matrix(2, 3)),
}


@pytest.fixture(params=PROBLEMS)
def qubo(request):
    return PROBLEMS[request.param]


def all_states(qubo):
    states = binary_states(qubo.n, like=qubo.linear)
    return states.expand(*qubo.problems, *states.shape)


def solve(solver, qubo, seed=0):
    return solver.minimise(qubo, generator=rng.stream(seed, "solver"))


@pytest.mark.parametrize("chunk_size", [2**16, 13])
def test_brute_force_is_the_minimum_over_all_states(qubo, chunk_size):
    solution = solve(BruteForce(chunk_size=chunk_size), qubo)
    lowest, index = qubo.energy(all_states(qubo)).min(-1)
    torch.testing.assert_close(solution.best_energy, lowest, rtol=1e-13, atol=0)
    expected = all_states(qubo).take_along_dim(index[..., None, None], dim=-2).squeeze(-2)
    assert solution.best.equal(expected)
    assert solution.energies.shape == (*qubo.problems, 1)
    assert (solution.status == Status.OPTIMAL).all()


def test_brute_force_refuses_more_variables_than_allowed():
    with pytest.raises(SettingError, match=r"variables to enumerate = 11 .* at most max_variables = 7"):
        solve(BruteForce(max_variables=7), PROBLEMS["dense"])


def test_brute_force_counts_the_smaller_layer_of_a_model():
    qubo = PROBLEMS["model 7 x 5"]
    assert solve(BruteForce(max_variables=5), qubo).steps.tolist() == [32]
    with pytest.raises(SettingError, match="variables to enumerate = 5"):
        solve(BruteForce(max_variables=3), qubo)


def test_descent_never_rises(qubo):
    energies = torch.stack(
        [solve(AlternatingDescent(n_restarts=23, max_sweeps=k), qubo).energies for k in range(1, 8)]
    )
    assert (energies.diff(dim=0) <= 1e-12).all()
    assert (energies.diff(dim=0) < -1e-3).any()


def test_descent_first_sweep_does_not_rise_above_the_start(qubo):
    shape = (*qubo.problems, 23, qubo.n)
    start = (rng.uniform(shape, generator=rng.stream(0, "solver"), like=qubo.linear) < 0.5).double()
    after = solve(AlternatingDescent(n_restarts=23, max_sweeps=1), qubo).energies
    assert (after <= qubo.energy(start) + 1e-12).all()


def test_descent_ends_where_no_block_improves(qubo):
    solution = solve(AlternatingDescent(n_restarts=23), qubo)
    assert (solution.status == Status.CONVERGED).all()
    for block in qubo.graph.blocks():
        width = block.stop - block.start
        for setting in binary_states(width, like=qubo.linear):
            other = solution.assignments.clone()
            other[..., block] = setting
            assert (qubo.energy(other) >= solution.energies - 1e-12).all()


def test_descent_with_many_restarts_finds_the_minimum(qubo):
    best = solve(AlternatingDescent(n_restarts=211), qubo).best_energy
    torch.testing.assert_close(best, solve(BruteForce(), qubo).best_energy)


def test_descent_says_when_its_sweeps_were_used_up():
    solution = solve(AlternatingDescent(n_restarts=23, max_sweeps=1), PROBLEMS["dense"])
    assert (solution.status == Status.STEP_BUDGET).any()
    assert (solution.steps == 1).all()


def test_best_is_the_restart_of_lowest_energy(qubo):
    solution = solve(AlternatingDescent(n_restarts=23), qubo)
    assert solution.best.shape == (*qubo.problems, qubo.n)
    torch.testing.assert_close(qubo.energy(solution.best.unsqueeze(-2)).squeeze(-1), solution.energies.amin(-1))


def test_messages_count_the_restarts_with_advice():
    solution = solve(AlternatingDescent(n_restarts=23), PROBLEMS["batch of dense"])
    assert solution.messages() == {f"CONVERGED: {Status.CONVERGED.advice}": 6 * 23}
