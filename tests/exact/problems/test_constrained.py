"""Constraints and long clauses against enumeration: what is broken, what a penalty costs, what a clause weighs."""

import random

import numpy as np
import pytest
import torch

from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Constrained, Linear, Qubo, WeightedMaxSat, clause, exactly, to_qubo
from memcomp_lightning.problems.constrained import as_qubo

N = 5
KINDS = ["clauses", "exactly", "linear", "mixed"]


def random_constraint(draw, kind):
    """One constraint, and whether a state keeps it."""
    if kind == "mixed":
        kind = draw.choice(KINDS[:3])
    chosen = draw.sample(range(N), draw.randint(1, N))
    if kind == "clauses":
        literals = [draw.choice([-1, 1]) * (variable + 1) for variable in chosen]
        return clause(literals), lambda x: any(x[abs(q) - 1] == (q > 0) for q in literals)
    if kind == "exactly":
        k = draw.randint(0, len(chosen))
        return exactly(k, chosen), lambda x: sum(x[i] for i in chosen) == k
    a = {variable: draw.choice([-3, -2, -1, 0, 1, 2, 3]) for variable in chosen}
    low, high = sorted((draw.randint(-4, 4), draw.randint(-4, 4)))
    low, high = draw.choice([(low, high), (low, None), (None, high), (low, low)])

    def holds(x):
        total = sum(a[i] * x[i] for i in a)
        return (low is None or low <= total) and (high is None or total <= high)

    return Linear(a, low, high), holds


def random_problem(seed, kind, *, maxsat):
    draw = random.Random(f"{seed}{kind}")
    if maxsat:
        clauses = [
            [draw.choice([-1, 1]) * i for i in draw.sample(range(1, N + 1), draw.randint(0, 4))] for _ in range(5)
        ]
        objective = WeightedMaxSat.from_clauses(N, clauses, [draw.randint(0, 5) for _ in clauses], 2)
    else:
        entries = np.array([[draw.randint(-4, 4) for _ in range(N)] for _ in range(N)], np.float64)
        objective = Qubo.from_matrix(entries, np.array(3.0))
    rows = [random_constraint(draw, kind) for _ in range(3)]
    return Constrained.of(objective, [row for row, _ in rows]), [holds for _, holds in rows]


def lowest_over_auxiliaries(qubo):
    """Energy of each state of the first variables with the best values of the auxiliary ones, ``(2^N,)``."""
    states = binary_states(qubo.n, like=qubo.linear)
    return to_numpy(qubo.energy(states)).reshape(2**N, -1).min(1)


@pytest.mark.parametrize("maxsat", [False, True], ids=["qubo", "maxsat"])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("like", [np.zeros(0), torch.zeros(0)], ids=["numpy", "torch"])
def test_what_is_broken_and_what_it_costs(kind, maxsat, like):
    for seed in range(10):
        problem, holds = random_problem(seed, kind, maxsat=maxsat)
        problem = Constrained(problem.objective.alike(like), problem.constraints)
        states = binary_states(N, like=problem.objective.offset)
        broken = np.array([[not keeps(x) for keeps in holds] for x in to_numpy(states).astype(int).tolist()])
        assert problem.n_broken(states).tolist() == broken.sum(1).tolist()
        penalised = problem.penalised(np.array([1.0, 10.0, 100.0]))
        assert isinstance(penalised, WeightedMaxSat) or not (maxsat and kind == "clauses")
        extra = lowest_over_auxiliaries(as_qubo(penalised)) - to_numpy(problem.energy(states))
        at_least = broken @ [1.0, 10.0, 100.0]
        if kind == "clauses":
            np.testing.assert_allclose(extra, at_least, atol=1e-9)
        assert (extra > at_least - 1e-9).all()
        np.testing.assert_allclose(extra[broken.sum(1) == 0], 0, atol=1e-9)


@pytest.mark.parametrize("n_values", [1, 2, 3, 4, 5])
def test_a_row_costs_more_the_further_its_sum_is_from_the_bounds(n_values):
    row = Linear(dict.fromkeys(range(N), 1), 1, n_values)
    problem = Constrained.of(Qubo.from_matrix(np.zeros((N, N))), [row])
    sums = binary_states(N, like=np.zeros(0)).sum(1)
    excess = np.maximum(1 - sums, 0) + np.maximum(sums - n_values, 0)
    expected = excess**2 if n_values == 1 else excess * (excess + 1) / 2
    assert lowest_over_auxiliaries(as_qubo(problem.penalised(np.ones(1)))).tolist() == expected.tolist()


@pytest.mark.parametrize("dtype", [np.float64, np.int64])
def test_long_clauses_as_a_qubo(dtype):
    draw = random.Random(0)
    for length in range(3, N + 1):
        clauses = [[draw.choice([-1, 1]) * i for i in draw.sample(range(1, N + 1), length)] for _ in range(2)]
        clauses += [[1, -2], [3]]
        maxsat = WeightedMaxSat.from_clauses(N, clauses, [3, 5, 7, 2], 4, dtype)
        floating = WeightedMaxSat.from_clauses(N, clauses, [3, 5, 7, 2], 4)
        qubo = to_qubo(maxsat)
        assert qubo.linear.dtype == dtype
        expected = floating.energy(binary_states(N, like=np.zeros(0)))
        assert lowest_over_auxiliaries(qubo).tolist() == expected.tolist()


def test_a_batch_of_objectives_shares_the_constraints():
    matrices = np.arange(2 * N * N, dtype=np.float64).reshape(2, N, N) % 7 - 3
    rows = [exactly(2, range(N)), clause([1, 2, 3])]
    states = binary_states(N, like=np.zeros(0))
    both = Constrained.of(Qubo.from_matrix(matrices), rows)
    penalties = np.array([[1.0, 2.0], [3.0, 4.0]])
    energies = both.penalised(penalties).energy(np.broadcast_to(binary_states(N + 1, like=states), (2, 64, N + 1)))
    for k in range(2):
        one = Constrained.of(Qubo.from_matrix(matrices[k]), rows).penalised(penalties[k])
        np.testing.assert_allclose(energies[k], one.energy(binary_states(N + 1, like=states)))


def test_repeated_and_opposite_literals():
    states = binary_states(2, like=np.zeros(0))
    problem = Constrained.of(Qubo.from_matrix(np.zeros((2, 2))), [clause([1, 1]), clause([1, -1]), clause([])])
    assert problem.n_broken(states).tolist() == [2, 2, 1, 1]


@pytest.mark.parametrize("row", [Linear({0: 2, 1: 4}, 3, 3), Linear({0: 1}, 2, None), Linear({0: 3}, None, -1)])
def test_what_no_state_keeps_costs_something_everywhere(row):
    problem = Constrained.of(Qubo.from_matrix(np.zeros((N, N))), [row])
    assert (problem.n_broken(binary_states(N, like=np.zeros(0))) == 1).all()
    assert (lowest_over_auxiliaries(as_qubo(problem.penalised(np.ones(1)))) >= 1).all()


def test_a_common_factor_is_left_out():
    rows = Constrained.of(Qubo.from_matrix(np.zeros((2, 2))), [Linear({0: 4, 1: 4}, None, 7)]).constraints
    assert rows.are_clauses, "both at once are too much"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (exactly(1, [0, N]), "variables of constraint 1 = \\[5\\]"),
        (clause([-6]), "integers from 0 to n - 1 = 4"),
        (Linear({0: 0.5}, 0, 1), "whole numbers"),
        (Linear({0: 2**31}, 0, 1), "less than 2\\^31"),
    ],
)
def test_refusals(row, message):
    with pytest.raises(SettingError, match=message):
        Constrained.of(Qubo.from_matrix(np.zeros((N, N))), [row])


def test_no_literal_is_0():
    with pytest.raises(SettingError, match="literal = 0"):
        clause([1, 0])
