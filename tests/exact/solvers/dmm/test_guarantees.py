"""What holds for every finite problem: bounds, finite numbers, no energy below the minimum."""

import dataclasses
import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.problems import Bipartite, EdgeList, Qubo, WeightedMaxSat, from_qubo
from memcomp_lightning.solvers import BruteForce, Status
from memcomp_lightning.solvers.dmm import (
    AdaptiveEuler,
    BondField,
    ClauseField,
    DmmSolver,
    Heun,
    Recording,
    Splitting,
    Strang,
    WarmRestart,
)
from memcomp_lightning.solvers.dmm.kernels import cpu, reference
from memcomp_lightning.solvers.dmm.kernels.run import Start

SCHEMES = [AdaptiveEuler, Splitting, Strang, Heun]
FIELDS = {
    "clauses": ClauseField(),
    "clauses with noise": ClauseField(noise=2.0, spread=1.0),
    "clauses, long steps": ClauseField(
        alpha=40.0,
        beta=30.0,
        gamma=0.45,
        delta=0.4,
        epsilon=1.0,
        zeta=0.0,
        long_term_max=50.0,
        unit_pull=5.0,
        spread=1.0,
        integrator=Splitting(change=20.0, dt_min=1.0, dt_max=5.0),
    ),
    "bonds": BondField(),
    "bonds, long steps": BondField(
        alpha=20.0,
        beta=30.0,
        gamma=20.0,
        kappa=3.0,
        delta=20.0,
        zeta=0.1,
        long_term_max=30.0,
        noise=3.0,
        integrator=Splitting(change=20.0, dt_min=1.0, dt_max=5.0),
    ),
}


def normal(*shape, seed):
    return torch.empty(shape).normal_(generator=rng.stream(seed, "test draws"))


def uniform(*shape, seed):
    return rng.uniform(shape, generator=rng.stream(seed, "test draws"))


def wild(*shape, seed):
    """Signs times sizes from 1e-30 to 1e30."""
    return normal(*shape, seed=seed).sign() * 10 ** (60 * uniform(*shape, seed=seed + 1) - 30)


def extremes():
    matrix, diagonal = normal(7, 7, seed=1), torch.arange(7)
    far_below = matrix * 1e-30
    far_below[0, 0] = 1
    fields = matrix.clone()
    fields[diagonal, diagonal] *= torch.tensor([1.0, 1e30, 1.0, -1e10, 1e4, 1.0, -1e20])
    yield "tiny", matrix * 1e-30
    yield "huge", matrix * 1e30
    yield "zero", torch.zeros(5, 5)
    yield "no couplings", torch.diag(torch.tensor([1.0, -2.0, 0.0]))
    yield "one variable", torch.tensor([[-3.0]])
    yield "one variable of no weight", torch.zeros(1, 1)
    yield "one huge coupling", matrix + 1e30 * torch.eye(7).roll(1, 0)
    yield "couplings far below a field", far_below
    yield "huge fields", fields
    yield "isolated variables", matrix * (diagonal < 3) * (diagonal < 4)[:, None]
    yield "ferromagnet", -torch.ones(9, 9).triu(1)
    yield "antiferromagnet", torch.ones(9, 9).triu(1)
    yield "integers with ties", (2 * matrix).round()
    for seed in range(2):
        yield f"wild {seed}", wild(6, 6, seed=10 * seed)
        n = int(1 + 12 * uniform(1, seed=seed))
        sparse = normal(n, n, seed=seed + 50) * (uniform(n, n, seed=seed + 60) < 0.4)
        yield f"random {seed}", sparse


def problems():
    found = {name: Qubo.from_matrix(matrix) for name, matrix in extremes()}
    entries = torch.tensor([[0, 3], [3, 0], [1, 1], [1, 1], [2, 4], [0, 3]])
    found["duplicate entries"] = Qubo.from_coo(5, *entries.T, torch.tensor([1.0, -2.0, 1e20, 0.5, -1.0, 1.0]))
    repeated = EdgeList(n=4, pairs=torch.tensor([[0, 1], [0, 1], [1, 3]]))
    found["a pair listed twice"] = Qubo(
        repeated, torch.tensor([1.0, -3.0, 2.0]), normal(4, seed=3), torch.tensor(0.0)
    )
    for m, n in ((6, 3), (1, 4), (1, 1)):
        graph = Bipartite(m, n)
        coupling, linear = (
            (normal(n, m, seed=5), normal(m + n, seed=6)) if m > 1 else (wild(n, m, seed=7), wild(m + n, seed=8))
        )
        found[f"layers of {m} and {n}"] = Qubo(graph, coupling, linear, torch.tensor(1.0))
        found[f"layers of {m} and {n} without couplings"] = Qubo(graph, 0 * coupling, linear, torch.tensor(0.0))
    found["layers of no weight"] = Qubo(graph, 0 * coupling, 0 * linear, torch.tensor(0.0))
    return found


def clauses():
    literals = [[1, 2, 3], [-1, 4, 5], [2, -5, 6, -1], [-3, -4, -6], [1, 2], [-2, 7], [3], [-7], [1, 2, 3], []]
    weights = (0.5 + uniform(10, seed=1)).tolist()
    made = {
        "clauses": WeightedMaxSat.from_clauses(8, literals, weights),
        "wild clauses": WeightedMaxSat.from_clauses(8, literals, wild(10, seed=2).abs().tolist()),
        "clauses of no weight": WeightedMaxSat.from_clauses(8, literals, [0.0] * 10),
        "huge unit beside longer clauses": WeightedMaxSat.from_clauses(8, [*literals, [4]], [*weights, 1e12]),
        "no clauses": WeightedMaxSat.from_clauses(3, [], []),
        "longer clauses alone": WeightedMaxSat.from_clauses(6, literals[:4], weights[:4]),
    }
    return {name: problem.alike(torch.zeros(())) for name, problem in made.items()}


PROBLEMS, CLAUSES = problems(), clauses()


def with_axis(problem):
    """As the kernels take it, with one axis of problems."""
    names = (
        ("weight", "first", "second", "unit") if isinstance(problem, WeightedMaxSat) else ("coupling", "linear")
    )
    parts = {name: getattr(problem, name).unsqueeze(0) for name in (*names, "offset")}
    if isinstance(problem, WeightedMaxSat):
        parts["longer"] = tuple(
            dataclasses.replace(block, weight=block.weight.unsqueeze(0)) for block in problem.longer
        )
    return dataclasses.replace(problem, **parts)


def suits(field, problem):
    return isinstance(field, ClauseField) or not getattr(problem, "longer", ())


def start(problem, field, n_restarts=5):
    generator = rng.stream(0, "start")
    voltage = field.spread * (2 * rng.uniform((1, n_restarts, problem.n), generator=generator) - 1)
    voltage[:, 0] = 0
    voltage = voltage.to(problem.linear.dtype if isinstance(problem, Qubo) else problem.unit.dtype)
    return Start(voltage, (), torch.randint(2**32, (1, n_restarts), generator=generator))


def limits(field):
    """Bounds of each tensor of a state, by the end of its name."""
    low = field.short_term_min if isinstance(field, BondField) else 0
    return {"voltage": (-1, 1), "short_term": (low, 1), "long_term": (1, field.long_term_max)}


def within(x, low, high):
    """To the rounding of the bounds themselves; NaN is nowhere."""
    return bool(((x >= low - 1e-6 * abs(low)) & (x <= high + 1e-6 * abs(high))).all())


# --- bounds -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("key", [key for key in FIELDS if key != "clauses with noise"])
def test_every_scheme_keeps_the_bounds(key, scheme):
    """After each step: voltages, all memories, step sizes."""
    field = FIELDS[key]
    control = {name: getattr(field.integrator, name) for name in ("change", "dt_min", "dt_max")}
    integrator = scheme(**control)
    for name, problem in (PROBLEMS | CLAUSES).items():
        if not suits(field, problem):
            continue
        problem = with_axis(problem)
        machine = field.build(problem)
        state = field.init(machine, start(problem, field).voltage)
        for step in range(5):
            state, dt, _ = integrator.step(field, machine, state)
            assert within(dt, integrator.dt_min, integrator.dt_max), f"{name}, step {step}"
            for part, x in zip(state._fields, state, strict=True):
                bounds = next(bound for end, bound in limits(field).items() if part.endswith(end))
                assert within(x, *bounds), f"{name}, step {step}: {part} in {x.min()} .. {x.max()}"


@pytest.mark.parametrize("kernel", [reference, cpu], ids=["reference", "compiled"])
@pytest.mark.parametrize("key", FIELDS)
def test_every_kernel_keeps_the_bounds(key, kernel):
    """Voltages and long-term memories at the end of runs with noise and descents."""
    field = FIELDS[key]
    for name, problem in (PROBLEMS | CLAUSES).items():
        if not suits(field, problem):
            continue
        problem = with_axis(problem)
        run = kernel.run(
            field,
            field.integrator,
            problem,
            start(problem, field),
            n_steps=7,
            quench_every=4,
            recording=Recording(every=1),
        )
        assert within(run.voltage, -1, 1), f"{name}: voltage"
        for memory in run.kept:
            assert within(1 + memory, 1, field.long_term_max), f"{name}: long-term memory"
        assert bool(run.visited.time.isfinite().all()), f"{name}: time"
        assert bool((run.visited.time.diff(dim=-1) > 0).all()), f"{name}: time"


# --- energies ---------------------------------------------------------------------------------------------


def lowest(problem):
    """Over all states."""
    like = problem.linear if isinstance(problem, Qubo) else problem.unit
    return problem.energy(binary_states(problem.n, like=like)).min()


MINIMA = {name: lowest(problem) for name, problem in (PROBLEMS | CLAUSES).items()}


@pytest.mark.parametrize("name", PROBLEMS)
def test_minima_are_those_of_brute_force(name):
    exact = BruteForce().minimise(PROBLEMS[name], generator=rng.stream(0, "unused")).best_energy
    torch.testing.assert_close(exact, MINIMA[name], rtol=1e-7, atol=0)


def check(solution, problem, name, minimum):
    """Finite, of the assignments, not below the minimum."""
    assert bool(solution.energies.isfinite().any(-1)), name
    run = solution.status != Status.NOT_RUN
    assert bool(solution.energies[run].isfinite().all()), name
    assert solution.energies[run].equal(problem.energy(solution.assignments)[run]), name
    assert bool(((solution.assignments == 0) | (solution.assignments == 1)).all()), name
    assert bool((solution.energies >= minimum).all()), name
    assert bool(solution.trajectory.unsatisfied_weight.isfinite().all()), name
    assert bool(solution.trajectory.time.isfinite().all()), name


@pytest.mark.parametrize(("kernel", "quench_every"), [("compiled", 0), ("compiled", 3), ("reference", 3)])
@pytest.mark.parametrize("key", FIELDS)
def test_never_an_energy_below_the_minimum(key, quench_every, kernel):
    field = FIELDS[key]
    solver = DmmSolver(
        field=field,
        n_restarts=4,
        patience=2,
        max_steps=7,
        quench_every=quench_every,
        warm=WarmRestart(),
        record=Recording(every=3),
        kernel=kernel,
    )
    for name, problem in (PROBLEMS | CLAUSES).items():
        if suits(field, problem):
            check(solver.minimise(problem, generator=rng.stream(0, "solver")), problem, name, MINIMA[name])


HARDEST = ("huge", "zero", "one huge coupling", "huge fields", "wild 0", "layers of 1 and 4", "wild clauses")


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("key", ["clauses with noise", "bonds"])
def test_never_an_energy_below_the_minimum_with_any_scheme(key, scheme):
    solver = DmmSolver(
        field=FIELDS[key], integrator=scheme(), n_restarts=3, max_steps=7, record=Recording(every=3)
    )
    for name in HARDEST:
        problem = (PROBLEMS | CLAUSES)[name]
        if suits(FIELDS[key], problem):
            check(solver.minimise(problem, generator=rng.stream(0, "solver")), problem, name, MINIMA[name])


@pytest.mark.parametrize("kernel", ["compiled", "reference"])
@pytest.mark.parametrize("key", ["clauses", "bonds"])
@pytest.mark.parametrize("seed", range(4))
def test_random_problems_in_every_form(seed, key, kernel):
    """QUBO and MAX-SAT, dense and sparse, scaled by anything: the minimum to rounding, with descents."""
    n = 2 + int(11 * uniform(1, seed=seed))
    scale = 10 ** float(60 * uniform(1, seed=seed + 10) - 30)
    matrix = normal(n, n, seed=seed + 20) * (uniform(n, n, seed=seed + 30) < uniform(1, seed=seed + 40)) * scale
    solver = DmmSolver(
        field=FIELDS[key], n_restarts=20, max_steps=41, record=Recording(every=20), quench_every=2, kernel=kernel
    )
    qubo = Qubo.from_matrix(matrix)
    minimum, size = lowest(qubo), matrix.abs().sum().item()
    for problem in (qubo, from_qubo(qubo), Qubo.from_matrix(matrix.double())):
        solution = solver.minimise(problem, generator=rng.stream(0, "solver"))
        check(solution, problem, "random", minimum - 1e-6 * size)
        assert math.isclose(solution.best_energy.item(), minimum.item(), rel_tol=1e-6, abs_tol=1e-6 * size)
