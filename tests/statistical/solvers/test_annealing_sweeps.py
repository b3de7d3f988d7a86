"""The compiled sweeps of annealing at one temperature: their states follow exp(-beta E)."""

import numpy as np
import pytest

from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.problems import Bipartite, Qubo
from memcomp_lightning.rng import numpy_stream
from memcomp_lightning.solvers.compiled import Layers, float32, seen_from_variables
from memcomp_lightning.solvers.kernels import annealing, random

N_SWEEPS, N_BLOCKS = 40_000, 40


def layered_states(problem: Layers, beta: np.float32, generator: np.random.Generator) -> np.ndarray:
    """States of a chain, half a sweep a layer, fields kept by events."""
    of_first, of_second = (part[0] for part in problem.rows(float32))
    own = float32(problem.own[0])
    n_first, n = len(of_first), len(own)
    x, field, flipped = np.zeros(n, np.float32), own.copy(), np.empty(n + 1, np.int64)
    pool, states = random.thresholds(n), np.empty((N_SWEEPS, n))
    layers = (slice(0, n_first), slice(n_first, n))
    for sweep in range(N_SWEEPS):
        for here, there, rows in ((*layers, of_first), (*layers[::-1], of_second)):
            at = generator.integers(random.N_THRESHOLDS)
            n_flipped = annealing._draw(x[here], field[here], pool[at:], beta, flipped)
            annealing._add_rows(field[there], rows, flipped, n_flipped, x[here])
        states[sweep] = x
    return states


def listed_states(problem, beta, generator):
    """States of as many chains as there are lanes, variable after variable."""
    pairs = (problem.begins, problem.variables, float32(problem.couplings[0]))
    n = problem.own.shape[1]
    x, field = np.zeros((2, n, annealing.LANES), np.float32)
    field[:] = problem.own[0][:, None]
    pool, change = random.thresholds(annealing.LANES), np.empty(annealing.LANES, np.float32)
    states = np.empty((N_SWEEPS // annealing.LANES, n, annealing.LANES))
    for sweep in range(len(states)):
        at = generator.integers(random.N_THRESHOLDS)
        annealing.sweep_lanes(x, field, pairs, pool, at, beta, change)
        states[sweep] = x
    return states.transpose(0, 2, 1).reshape(-1, n)


@pytest.mark.parametrize("listed", [False, True], ids=["layers", "pairs"])
@pytest.mark.parametrize("beta", [0.3, 1.1])
def test_states_follow_the_distribution(beta, listed):
    generator = numpy_stream(1, "states")
    coupling, linear = generator.normal(size=(3, 4)), generator.normal(size=7)
    qubo = Qubo(Bipartite(4, 3), coupling, linear, np.zeros(()))
    every = binary_states(7, like=linear)
    weight = np.exp(-beta * qubo.energy(every))
    probability = weight / weight.sum()
    if listed:
        matrix = np.zeros((7, 7))
        matrix[4:, :4] = coupling
        qubo = Qubo.from_matrix(matrix + np.diag(linear))
    problem = seen_from_variables(qubo)
    states = (listed_states if listed else layered_states)(problem, np.float32(beta), generator)

    def pairs(x):
        return (x[:, :, None] * x[:, None]).reshape(-1, 49).T

    for given, ours in (
        (qubo.energy(every) @ probability, qubo.energy(states)),
        (every.T @ probability, states.T),
        (pairs(every) @ probability, pairs(states)),
    ):
        blocks = np.stack([block.mean(-1) for block in np.array_split(ours, N_BLOCKS, axis=-1)])
        error = blocks.std(0, ddof=1) / np.sqrt(N_BLOCKS)
        assert (np.abs(blocks.mean(0) - given) < 5 * error + 1e-9).all()


def test_thresholds_are_the_quantiles_of_the_logistic_distribution():
    pool = random.thresholds(10)
    assert np.array_equal(pool[:10], pool[random.N_THRESHOLDS :])
    share = (pool[: random.N_THRESHOLDS, None] < np.array([-3.0, 0.0, 2.0])).mean(0)
    np.testing.assert_allclose(share, 1 / (1 + np.exp([3.0, 0.0, -2.0])), atol=2e-5)
