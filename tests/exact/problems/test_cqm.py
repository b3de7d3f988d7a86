"""Constrained quadratic models of dimod against dimod's own counting."""

import itertools
import random

import numpy as np
import pytest

from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Constrained

dimod = pytest.importorskip("dimod")

from memcomp_lightning.problems import from_cqm  # noqa: E402


def random_model(seed):
    """Binary and spin variables; whole and decimal coefficients."""
    draw = random.Random(seed)
    binary, spin = dimod.Binaries([f"x{i}" for i in range(3)]), dimod.Spins([f"s{i}" for i in range(3)])
    variables = [*binary, *spin]
    cqm = dimod.ConstrainedQuadraticModel()
    pairs = itertools.combinations(variables, 2)
    objective = sum(draw.randint(-3, 3) * u * v for u, v in pairs)
    cqm.set_objective(objective + sum(draw.uniform(-2, 2) * v for v in variables) + 1.25)
    for k in range(4):
        chosen = draw.sample(variables, draw.randint(1, 4))
        left = sum(draw.choice([-2, -1, 1, 3, 0.5, 0.1, -0.25]) * v for v in chosen) + draw.choice([0, 1])
        right = draw.choice([-1, 0, 1, 1.5, 0.35])
        cqm.add_constraint([left <= right, left >= right, left == right][draw.choice([0, 1, 0, 1, 2])], label=k)
    cqm.add_discrete(["d0", "d1"], label="one of two")
    return cqm


def test_objective_and_broken_constraints_are_those_of_dimod():
    n_kept = 0
    for seed in range(20):
        cqm = random_model(seed)
        problem, names = from_cqm(cqm)
        assert isinstance(problem, Constrained)
        states = np.array(list(itertools.product((0, 1), repeat=len(names))))
        spins = [cqm.vartype(name) is dimod.SPIN for name in names]
        values = np.where(spins, 2 * states - 1, states)
        np.testing.assert_allclose(problem.energy(states), cqm.objective.energies((values, names)), atol=1e-9)
        broken = [
            sum(bool(v.violation > 1e-9) for v in cqm.iter_constraint_data(dict(zip(names, x, strict=True))))
            for x in values.tolist()
        ]
        assert problem.n_broken(states).tolist() == broken
        n_kept += broken.count(0)
    assert n_kept > 100


def test_an_objective_that_is_left_out():
    cqm = dimod.ConstrainedQuadraticModel()
    cqm.add_discrete(["a", "b"])
    problem, names = from_cqm(cqm)
    assert names == ["a", "b"]
    assert problem.energy(np.eye(2)).tolist() == [0, 0]


def refused(kind):
    cqm = dimod.ConstrainedQuadraticModel()
    x, y = dimod.Binaries(["x", "y"])
    cqm.set_objective(x + y)
    if kind == "integer":
        cqm.add_constraint(dimod.Integer("i") + x <= 3)
    elif kind == "quadratic":
        cqm.add_constraint(x * y <= 0, label="both")
    elif kind == "soft":
        cqm.add_constraint(x + y <= 1, weight=2.0, label="if you can")
    elif kind == "digits":
        cqm.add_constraint(0.1234567891 * x + y <= 1, label="long")
    return cqm


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("integer", "vartype of 'i' = 'INTEGER' .* BINARY or SPIN.*sum of binary"),
        ("quadratic", "constraint 'both' = 'quadratic' .* a linear constraint"),
        ("soft", "constraint 'if you can' = 'soft' .* a hard one"),
        ("digits", "numbers of constraint 'long' .* fewer digits"),
    ],
)
def test_refusals(kind, message):
    with pytest.raises(SettingError, match=message):
        from_cqm(refused(kind))
    with pytest.raises(SettingError, match="a model with at least one variable"):
        from_cqm(dimod.ConstrainedQuadraticModel())
