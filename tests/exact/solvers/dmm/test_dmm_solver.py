"""Optima, stopping rule, records and readout of the DMM solver."""

import dataclasses
import importlib.util
import itertools
import logging
import math
import resource
from typing import NamedTuple

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import RBM
from memcomp_lightning.objective import contrast
from memcomp_lightning.problems import Qubo, WeightedMaxSat, from_model, from_qubo
from memcomp_lightning.samplers import CD, PCD, GroundState, positive_phase
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
from memcomp_lightning.solvers.dmm import solver as solver_module
from memcomp_lightning.solvers.dmm.kernels import cpu, reference
from memcomp_lightning.testing.conformance import small_rbm


def normal(*shape, seed=0):
    return torch.empty(shape).normal_(generator=rng.stream(seed, "test draws"))


def solve(solver, qubo, seed=0):
    return solver.minimise(qubo, generator=rng.stream(seed, "solver"))


def minimum(qubo):
    return solve(BruteForce(), qubo).best_energy


either_kernel = pytest.mark.parametrize("kernel", ["compiled", "reference"])
either_field = pytest.mark.parametrize("field", [ClauseField(), BondField()], ids=["clauses", "bonds"])


# --- optima -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "qubo",
    [
        Qubo.from_matrix(normal(5, 11, 11)),
        from_model(small_rbm(11, 7, replicas=(2, 3))),
        from_model(small_rbm(7, 11, std=2.0)),
    ],
    ids=["dense", "models", "strong couplings"],
)
@either_field
@pytest.mark.parametrize("quench_every", [0, None])
def test_finds_the_optimum_of_random_problems(qubo, field, quench_every):
    solver = DmmSolver(field=field, n_restarts=13, max_steps=307, quench_every=quench_every, stall=None)
    solution = solve(solver, qubo)
    torch.testing.assert_close(solution.best_energy, minimum(qubo), rtol=1e-12, atol=1e-12)


def trained(sampler):
    """An RBM that has learnt stripes of a ring of 11 pixels with 7 hidden units."""
    rbm = RBM(11, 7, generator=rng.stream(0, "weights"))
    stripe = torch.tensor([1.0, 1, 1, 0, 0, 0, 1, 1, 0, 0, 0])
    v = torch.stack([stripe.roll(shift) for shift in range(11)])
    optimizer = torch.optim.SGD(rbm.parameters(), lr=0.3, momentum=0.5)
    generator = rng.stream(0, "negative_phase")
    state = sampler.init(rbm, len(v), generator=generator)
    for _ in range(211):
        positive = positive_phase(rbm, v)
        negative = sampler.sample(rbm, state, positive, generator=generator)
        state = negative.state
        optimizer.zero_grad()
        contrast(rbm, positive, negative.configurations).backward()
        optimizer.step()
    return rbm


@pytest.mark.parametrize("sampler", [CD(k=1), PCD(k=1, n_chains=23)], ids=["CD", "PCD"])
def test_finds_the_optimum_of_trained_models(sampler):
    rbm = trained(sampler)
    assert rbm.weight.abs().max() > 1
    qubo = from_model(rbm)
    for field in (ClauseField(), BondField()):
        solution = solve(DmmSolver(field=field, n_restarts=28, max_steps=307, quench_every=0), qubo)
        torch.testing.assert_close(solution.best_energy, minimum(qubo), rtol=1e-12, atol=1e-12)


@either_kernel
@either_field
def test_energies_are_those_of_the_assignments(field, kernel):
    qubo = from_model(small_rbm(replicas=(2, 3)))
    solution = solve(DmmSolver(field=field, n_restarts=5, max_steps=3, quench_every=0, kernel=kernel), qubo)
    assert solution.energies.equal(qubo.energy(solution.assignments))
    assert (solution.energies.amax(-1) > solution.energies.amin(-1)).any()


def test_more_steps_never_give_a_higher_energy():
    qubo = Qubo.from_matrix(normal(3, 11, 11))
    few, many = (solve(DmmSolver(n_restarts=7, max_steps=n, quench_every=0), qubo).energies for n in (2, 41))
    assert (many <= few).all()
    assert (many < few).any()


# --- streams and shapes -----------------------------------------------------------------------------------


@either_kernel
@either_field
@pytest.mark.parametrize("patience", [None, 2])
def test_same_stream_gives_the_same_solution_and_another_one_another(patience, field, kernel):
    solver = DmmSolver(
        field=field, n_restarts=5, patience=patience, max_steps=11, record=Recording(every=3), kernel=kernel
    )
    qubo = Qubo.from_matrix(normal(3, 11, 11))
    first, again, other = (solve(solver, qubo, seed) for seed in (0, 0, 1))
    assert first.assignments.equal(again.assignments)
    assert first.energies.equal(again.energies)
    assert first.status.equal(again.status)
    assert all(a.equal(b) for a, b in zip(first.trajectory, again.trajectory, strict=True))
    assert not first.trajectory.assignments.equal(other.trajectory.assignments)


@either_kernel
@either_field
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("problems", [(), (1,), (3,), (2, 3)], ids=str)
def test_shapes(problems, dtype, field, kernel):
    qubo = Qubo.from_matrix(normal(*problems, 7, 7).to(dtype))
    solution = solve(DmmSolver(field=field, n_restarts=5, max_steps=11, kernel=kernel), qubo)
    assert solution.assignments.shape == (*problems, 5, 7)
    assert solution.energies.shape == solution.status.shape == solution.steps.shape == (*problems, 5)
    assert solution.best.shape == (*problems, 7)
    assert solution.best_energy.shape == problems
    assert solution.trajectory is None
    assert solution.assignments.dtype == qubo.linear.dtype


@either_kernel
def test_single_problem_equals_a_batch_of_one(kernel):
    matrix, solver = normal(7, 7), DmmSolver(n_restarts=5, max_steps=23, kernel=kernel)
    single, batch = solve(solver, Qubo.from_matrix(matrix)), solve(solver, Qubo.from_matrix(matrix[None]))
    assert single.assignments.equal(batch.assignments[0])
    assert single.energies.equal(batch.energies[0])


# --- stopping rule ----------------------------------------------------------------------------------------


class Voltages(NamedTuple):
    voltage: torch.Tensor


class ScriptedField:
    """Restart r of problem p stays at the assignment that reads ``table[p][r]`` in binary.

    The problem is known by its linear terms, which the script's QUBO numbers.
    """

    integrator = AdaptiveEuler()
    noise = 0.0
    spread = 1.0

    def __init__(self, table):
        self.table = torch.tensor(table)
        self.done = 0

    def qubo(self):
        number = torch.arange(1.0, len(self.table) + 1)
        linear = number[:, None] * torch.tensor([4.0, 2.0, 1.0])
        pair = torch.zeros(len(self.table), 3, 3)
        return Qubo.from_matrix(torch.diag_embed(linear) + pair)

    def build(self, problem):
        return (problem.linear[:, 2] - 1).long()

    def stability(self, machine):
        return torch.ones(len(machine), 1)

    def init(self, machine, voltage):
        n_restarts = voltage.shape[1]
        numbers = self.table[machine, self.done : self.done + n_restarts]
        self.done += n_restarts
        bits = (numbers[..., None] >> torch.tensor([2, 1, 0])) & 1
        return Voltages(2.0 * bits - 1)

    def derivative(self, machine, state):
        return Voltages(torch.zeros_like(state.voltage))

    def bound(self, machine, state):
        return state


def restarts_by_the_rule(energies, patience):
    """Groups of ``patience``; stop after one that ends ``patience`` restarts past the best."""
    lowest, since, done = float("inf"), 0, 0
    while done < len(energies):
        group = energies[done : done + patience]
        for energy in group:
            lowest, since = (energy, 0) if energy < lowest else (lowest, since + 1)
        done += len(group)
        if since >= patience:
            break
    return done


def test_the_rule_on_paper():
    assert restarts_by_the_rule([3, 3, 3, 3, 3, 3, 3], 2) == 4
    assert restarts_by_the_rule([5, 3, 3, 2, 2, 1, 1, 1], 2) == 8
    assert restarts_by_the_rule([1, 5, 5, 5, 0, 5, 5], 3) == 7


@pytest.mark.parametrize("patience", [1, 2, 3, 5, 7])
def test_stops_by_the_rule_problem_by_problem(patience):
    draw = rng.uniform((29, 7), generator=rng.stream(0, "test draws"))
    table = [*(8 * draw).long().tolist(), [7, 6, 5, 4, 3, 2, 1], [3] * 7, [0, 1, 2, 3, 4, 5, 6]]
    field = ScriptedField(table)
    solution = solve(
        DmmSolver(field=field, n_restarts=7, patience=patience, max_steps=2, quench_every=0), field.qubo()
    )
    expected = [restarts_by_the_rule(row, patience) for row in table]
    if patience < 5:
        assert len(set(expected)) > 1
    for number, (row, n_run) in enumerate(zip(table, expected, strict=True), start=1):
        energies = solution.energies[number - 1].tolist()
        assert energies == [number * e for e in row[:n_run]] + [float("inf")] * (7 - n_run)
        not_run = (solution.status[number - 1] == Status.NOT_RUN).tolist()
        assert not_run == [False] * n_run + [True] * (7 - n_run)
        assert solution.steps[number - 1].tolist() == [2] * n_run + [0] * (7 - n_run)
        assert solution.best_energy[number - 1] == number * min(row[:n_run])
    assert field.done == max(expected)


def test_without_patience_all_restarts_run():
    field = ScriptedField([[3] * 7, [5] * 7])
    solution = solve(DmmSolver(field=field, n_restarts=7, max_steps=2, quench_every=0), field.qubo())
    assert solution.energies.tolist() == [[3.0] * 7, [10.0] * 7]
    assert (solution.status != Status.NOT_RUN).all()


def test_patience_saves_restarts_of_a_real_problem_and_keeps_the_optimum():
    qubo = from_model(small_rbm(11, 7, replicas=(2, 3)))
    solution = solve(DmmSolver(n_restarts=23, patience=5, max_steps=211), qubo)
    torch.testing.assert_close(solution.best_energy, minimum(qubo), rtol=1e-12, atol=1e-12)
    n_run = (solution.status != Status.NOT_RUN).sum(-1)
    assert (n_run < 23).all()
    assert (solution.energies.isinf() == (solution.status == Status.NOT_RUN)).all()


class LateField(ScriptedField):
    """The only variable turns TRUE, which is better, at step 10."""

    def qubo(self):
        return Qubo.from_matrix(torch.tensor([[-1.0]]))

    def init(self, machine, voltage):
        return Voltages(torch.full_like(voltage, -0.95))

    def build(self, problem):
        return torch.zeros(1)

    def derivative(self, machine, state):
        return Voltages(torch.ones_like(state.voltage))


@pytest.mark.parametrize(
    ("max_steps", "status", "energy"),
    [
        (9, Status.STEP_BUDGET, 0),
        (10, Status.STILL_IMPROVING, -1),
        (11, Status.STILL_IMPROVING, -1),
        (12, Status.STEP_BUDGET, -1),
    ],
)
def test_status_tells_when_the_best_came(max_steps, status, energy):
    field = LateField([[0]])
    steady = AdaptiveEuler(change=1.0, dt_min=0.1, dt_max=0.1)
    solver = DmmSolver(
        field=field, integrator=steady, n_restarts=3, max_steps=max_steps, quench_every=0, stall=None
    )
    solution = solve(solver, field.qubo())
    assert (solution.status == status).all()
    assert (solution.energies == energy).all()


@pytest.mark.parametrize(("min_steps", "stall", "steps"), [(9, 0.5, 9), (12, 0.5, 17), (12, 3.0, 42)])
def test_a_restart_that_finds_nothing_better_for_long_stalls(min_steps, stall, steps, monkeypatch):
    monkeypatch.setattr(solver_module, "default_min_steps", lambda problem: min_steps)
    field = LateField([[0]])
    steady = AdaptiveEuler(change=1.0, dt_min=0.1, dt_max=0.1)
    solver = DmmSolver(field=field, integrator=steady, n_restarts=3, max_steps=50, quench_every=0, stall=stall)
    solution = solve(solver, field.qubo())
    assert (solution.status == Status.STALLED).all()
    assert (solution.steps == steps).all()
    assert (solution.energies == (0 if steps < 10 else -1)).all()
    full = solve(dataclasses.replace(solver, stall=None), field.qubo())
    assert (full.steps == 50).all()
    assert (full.status == Status.STEP_BUDGET).all()


# --- steps, readings, warm restarts -----------------------------------------------------------------------


class Call(NamedTuple):
    problem: object
    start: object
    settings: dict
    run: object


@pytest.fixture
def calls(monkeypatch):
    """What the solver hands to the kernels and what it gets."""
    seen = []

    def watch(module):
        run = module.run

        def watched(field, integrator, problem, start, **settings):
            result = run(field, integrator, problem, start, **settings)
            seen.append(Call(problem, start, {"kernel": module, "integrator": integrator, **settings}, result))
            return result

        monkeypatch.setattr(module, "run", watched)

    for module in (cpu, reference):
        watch(module)
    return seen


def without_couplings(n):
    none = torch.zeros(0, dtype=torch.int64)
    return Qubo.from_coo(n, none, none, torch.zeros(0))


@pytest.mark.parametrize("n", [1, 11, 1000])
def test_number_of_steps_follows_the_problem_unless_it_is_set(n, calls):
    solution = solve(DmmSolver(n_restarts=2, stall=None), without_couplings(n))
    assert solution.steps.tolist() == [solver_module.default_steps(without_couplings(n))] * 2
    assert calls[-1].settings["n_steps"] == solution.steps[0]
    assert solve(DmmSolver(n_restarts=2, max_steps=3), without_couplings(n)).steps.tolist() == [3, 3]


def test_default_number_of_steps_grows_more_slowly_than_the_problem():
    steps = [solver_module.default_steps(without_couplings(n)) for n in (1, 10, 100, 10**4, 4 * 10**4)]
    assert steps == sorted(steps)
    assert steps[0] >= 50
    assert 1.3 < steps[-1] / steps[-2] < 4


def test_readings_follow_the_problem_unless_they_are_set(calls):
    for problem in (from_model(small_rbm()), Qubo.from_matrix(normal(7, 7)), without_couplings(5)):
        solve(DmmSolver(n_restarts=2, max_steps=3), problem)
        assert calls[-1].settings["quench_every"] == solver_module.default_quench(problem) >= 1
        solve(DmmSolver(n_restarts=2, max_steps=3, quench_every=0), problem)
        assert calls[-1].settings["quench_every"] == 0


@either_kernel
@either_field
@pytest.mark.parametrize(
    "problem", [from_model(small_rbm(23, 19, replicas=(2,))), Qubo.from_matrix(normal(2, 19, 19))]
)
def test_descents_never_make_the_answer_worse(problem, field, kernel):
    """Of restarts that do not stall: the one that descends more often may end first."""
    settings = {"field": field, "n_restarts": 11, "max_steps": 15, "stall": None, "kernel": kernel}
    plain, rare, often = (solve(DmmSolver(quench_every=k, **settings), problem).energies for k in (0, 3, 1))
    assert (often <= plain + 1e-6).all()
    assert (often <= rare + 1e-6).all()
    assert (often < plain - 1e-3).any()


CREEPING = Splitting(change=0.1, dt_min=0.001, dt_max=0.2)


@either_kernel
@pytest.mark.parametrize(
    "field",
    [
        ClauseField(alpha=5.0, beta=0.4, gamma=0.03, delta=0.01, epsilon=0.04, spread=1.0, integrator=CREEPING),
        BondField(delta=4.0, zeta=1.0, long_term_max=2.0, noise=0.0, integrator=CREEPING),
    ],
    ids=["clauses", "bonds"],
)
@pytest.mark.parametrize("keep", [0.0, 0.5])
def test_warm_restart_goes_on_from_where_the_last_of_its_row_ended(keep, field, kernel, calls):
    """Problem by problem, also after those of no weight are done."""
    matrix = normal(9, 29, 29)
    matrix[::2] = 0
    problem = Qubo.from_matrix(matrix, offset=torch.arange(9.0))
    warm = WarmRestart(keep=keep, spread=0.3)
    solution = solve(
        DmmSolver(field=field, n_restarts=24, patience=4, max_steps=5, warm=warm, quench_every=0, kernel=kernel),
        problem,
    )
    n_run = (solution.status != Status.NOT_RUN).sum(-1)
    assert n_run.min() < n_run.max()
    assert not calls[0].start.kept
    assert calls[0].start.voltage.abs().max() <= field.spread
    for before, after in itertools.pairwise(calls):
        row = [before.problem.offset.tolist().index(offset) for offset in after.problem.offset.tolist()]
        kick = after.start.voltage - before.run.voltage[row]
        assert kick.abs().max() <= 0.3 + 1e-6
        assert kick.std() > 0.1
        assert after.start.voltage.abs().max() <= 1
        for ours, theirs in zip(after.start.kept, before.run.kept, strict=True):
            assert ours.equal(keep * theirs[row])
    assert any((memory > 0).any() for memory in calls[-1].start.kept) == (keep > 0)
    assert {len(call.problem.offset) for call in calls} > {9}


@either_kernel
def test_kept_memories_are_felt(kernel):
    qubo = Qubo.from_matrix(normal(3, 13, 13))

    def times(warm):
        solver = DmmSolver(
            n_restarts=8, patience=4, max_steps=15, warm=warm, record=Recording(every=1), kernel=kernel
        )
        return solve(solver, qubo).trajectory.time

    forgetting, keeping, cold = (times(warm) for warm in (WarmRestart(keep=0.0), WarmRestart(keep=0.5), None))
    assert forgetting[:, :4].equal(keeping[:, :4])
    assert cold[:, :4].equal(keeping[:, :4])
    assert not forgetting[:, 4:].equal(keeping[:, 4:])
    assert not forgetting[:, 4:].equal(cold[:, 4:])


@either_kernel
@either_field
def test_warm_restarts_find_the_optimum(field, kernel):
    qubo = from_model(small_rbm(11, 7, replicas=(2, 3)))
    solver = DmmSolver(field=field, n_restarts=24, patience=6, max_steps=101, warm=WarmRestart(), kernel=kernel)
    torch.testing.assert_close(solve(solver, qubo).best_energy, minimum(qubo), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("patience", [None, 5])
def test_warm_restarts_need_a_patience_that_divides_the_restarts(patience):
    message = rf"warm = .* a patience that divides n_restarts = 28\..*Set patience \(now {patience}\)"
    with pytest.raises(SettingError, match=message):
        DmmSolver(n_restarts=28, patience=patience, warm=WarmRestart())


# --- kernels ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "problem",
    [from_model(small_rbm()), Qubo.from_matrix(normal(7, 7)), from_qubo(Qubo.from_matrix(normal(7, 7)))],
    ids=["model", "dense", "MAX-SAT"],
)
@either_field
def test_the_compiled_kernel_runs_where_it_can(field, problem, calls):
    solve(DmmSolver(field=field, n_restarts=2, max_steps=3), problem)
    solve(DmmSolver(field=field, n_restarts=2, max_steps=3, kernel="reference"), problem)
    solve(DmmSolver(field=field, integrator=Heun(), n_restarts=2, max_steps=3), problem)
    assert [call.settings["kernel"] for call in calls] == [cpu, reference, reference]
    assert [type(call.settings["integrator"]) for call in calls] == [Splitting, Splitting, Heun]


class OtherClauseField(ClauseField):
    """May change any equation."""


@pytest.mark.parametrize("field", [ScriptedField([[0]]), OtherClauseField()])
def test_compiled_kernel_of_another_field_is_refused(field):
    message = (
        rf"^kernel = 'compiled' is not allowed: expected 'auto' or 'reference' here. {type(field).__name__} has"
    )
    with pytest.raises(SettingError, match=message):
        DmmSolver(field=field, kernel="compiled")


@pytest.mark.parametrize("integrator", [AdaptiveEuler(), Heun(), Strang()])
def test_compiled_kernel_of_another_integrator_is_refused_with_the_remedy(integrator):
    with pytest.raises(SettingError, match=rf"{type(integrator).__name__} has no compiled kernel: use Splitting"):
        DmmSolver(integrator=integrator, kernel="compiled")


@pytest.fixture
def no_numba(monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "numba" else find_spec(name, *rest)
    )
    solver_module._say_once.cache_clear()
    yield
    solver_module._say_once.cache_clear()


@pytest.mark.usefixtures("no_numba")
def test_without_numba_the_readable_kernel_runs_and_says_so_once(caplog):
    caplog.set_level(logging.INFO, logger="memcomp_lightning")
    qubo = from_model(small_rbm(replicas=(2,)))
    first, again = (solve(DmmSolver(n_restarts=5, max_steps=23), qubo) for _ in range(2))
    plain = solve(DmmSolver(n_restarts=5, max_steps=23, kernel="reference"), qubo)
    assert [record.message for record in caplog.records if "pip install numba" in record.message] == [
        "numba is not installed: the plain kernel is many times slower. pip install numba"
    ]
    for solution in (first, again):
        assert solution.assignments.equal(plain.assignments)
        assert solution.status.equal(plain.status)


@pytest.mark.usefixtures("no_numba")
def test_without_numba_the_compiled_kernel_is_refused_with_the_remedy():
    with pytest.raises(SettingError, match=r"kernel = 'compiled' .* numba is not installed.* pip install numba"):
        DmmSolver(kernel="compiled")


@either_field
def test_sparse_layers_are_solved_as_a_list_of_couplings(field, calls):
    qubo = from_model(small_rbm(9, 8, replicas=(2,)))
    used = torch.zeros(8, 9, dtype=torch.bool)
    used[torch.arange(8), torch.arange(8)] = used[0, 4] = True
    sparse = dataclasses.replace(qubo, coupling=qubo.coupling * used)
    solution = solve(DmmSolver(field=field, max_steps=53), sparse)
    assert calls[-1].problem.graph.edges().shape == (9, 2)
    torch.testing.assert_close(solution.best_energy, minimum(sparse), rtol=1e-12, atol=1e-12)
    assert solution.energies.equal(sparse.energy(solution.assignments))
    solve(DmmSolver(field=field, max_steps=3), qubo)
    assert calls[-1].problem.graph == qubo.graph


# --- MAX-SAT ----------------------------------------------------------------------------------------------


def clauses(n, lengths, seed):
    """Random clauses of each length, as many as the number beside it."""
    generator = rng.stream(seed, "clauses")
    rows = []
    for length, number in lengths.items():
        for draw in rng.uniform((number, n), generator=generator):
            variables = draw.argsort()[:length] + 1
            signs = torch.where(rng.uniform((length,), generator=generator) < 0.5, -1, 1)
            rows.append((variables * signs).tolist())
    return rows, (0.1 + rng.uniform((len(rows),), generator=generator)).tolist()


MAXSAT = {
    "units and pairs": (13, {1: 9, 2: 40}),
    "3-SAT": (13, {3: 80}),
    "all lengths": (11, {0: 1, 1: 5, 2: 15, 3: 30, 4: 15, 5: 10, 7: 3}),
    "one clause": (5, {4: 1}),
    "units": (7, {1: 11}),
}


@either_kernel
@pytest.mark.parametrize("quench_every", [0, None])
@pytest.mark.parametrize("name", MAXSAT)
def test_finds_the_optimum_of_maxsat(name, quench_every, kernel):
    """Without descents, one of the lowest energies: what is unsatisfied at the end is left to chance."""
    n, lengths = MAXSAT[name]
    problem = WeightedMaxSat.from_clauses(n, *clauses(n, lengths, seed=1), offset=0.7)
    solution = solve(DmmSolver(max_steps=307, quench_every=quench_every, kernel=kernel), problem)
    levels = problem.energy(binary_states(n, like=problem.unit))
    highest = np.quantile(levels, 0.01) if quench_every == 0 else levels.min() + 1e-12
    assert levels.min() - 1e-12 <= solution.best_energy <= highest
    assert np.array_equal(solution.energies, problem.energy(solution.assignments))
    assert solution.assignments.dtype == problem.unit.dtype


@either_kernel
def test_bonds_find_the_optimum_of_maxsat_with_two_literals(kernel):
    problem = WeightedMaxSat.from_clauses(13, *clauses(13, {1: 9, 2: 40}, seed=2))
    solution = solve(DmmSolver(field=BondField(), max_steps=307, kernel=kernel), problem)
    expected = problem.energy(binary_states(13, like=problem.unit)).min()
    torch.testing.assert_close(solution.best_energy, expected, rtol=1e-12, atol=1e-12)


@either_kernel
def test_maxsat_problems_of_one_shape_are_solved_together(kernel):
    one = WeightedMaxSat.from_clauses(9, *clauses(9, {1: 4, 2: 12, 3: 20, 4: 8}, seed=3)).alike(torch.zeros(()))
    factor = rng.uniform((2, 3, 1), generator=rng.stream(0, "weights"))
    many = dataclasses.replace(
        one,
        weight=factor * one.weight.flip(0) + (1 - factor) * one.weight,
        unit=factor * one.unit,
        offset=factor.squeeze(-1).double(),
        longer=tuple(
            dataclasses.replace(block, weight=factor * block.weight.flip(0) + (1 - factor) * block.weight)
            for block in one.longer
        ),
    )
    solver = DmmSolver(n_restarts=12, patience=4, max_steps=81, record=Recording(every=20), kernel=kernel)
    solution = solve(solver, many)
    states = binary_states(9, like=one.unit).expand(2, 3, -1, -1)
    torch.testing.assert_close(solution.best_energy, many.energy(states).amin(-1), rtol=1e-12, atol=1e-12)
    assert solution.assignments.shape == (2, 3, 12, 9)
    visited = solution.trajectory.assignments
    recorded = many.unsatisfied_weight(visited.flatten(-3, -2)).reshape(visited.shape[:-1])
    run = solution.status != Status.NOT_RUN
    torch.testing.assert_close(solution.trajectory.unsatisfied_weight[run], recorded[run])


@either_kernel
def test_clauses_of_three_literals_are_refused_by_the_bonds_with_the_remedy(kernel):
    problem = WeightedMaxSat.from_clauses(5, [[1, 2], [-1, 3, 4]], [1.0, 1.0])
    with pytest.raises(SettingError, match=r"longest clause = 3 .* at most 2 literals.*field=ClauseField\(\)"):
        solve(DmmSolver(field=BondField(), kernel=kernel), problem)


# --- size -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kernel", "quench_every"), [("compiled", None), ("reference", 0)])
@either_field
def test_memory_is_linear_in_the_couplings(field, kernel, quench_every):
    """A matrix of these 100,000 variables would have 40 GB."""
    n, n_pairs = 100_000, 200_000
    generator = rng.stream(0, "pairs")
    rows, columns = (torch.randint(n, (n_pairs,), generator=generator) for _ in range(2))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    qubo = Qubo.from_coo(n, rows, columns, normal(n_pairs))
    solver = DmmSolver(field=field, n_restarts=2, max_steps=4, quench_every=quench_every, kernel=kernel)
    solution = solve(solver, qubo)
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024 < 2e9
    assert solution.energies.max() < -0.3 * math.sqrt(n)


# --- records ----------------------------------------------------------------------------------------------


def recorded(problems=(2,), every=5, max_steps=23, **settings):
    qubo = Qubo.from_matrix(normal(*problems, 7, 7), offset=normal(*problems, seed=1))
    solver = DmmSolver(n_restarts=11, max_steps=max_steps, record=Recording(every=every), **settings)
    return qubo, solve(solver, qubo)


@either_kernel
@pytest.mark.parametrize("problems", [(), (2,), (2, 3)], ids=str)
def test_record_shapes(problems, kernel):
    trajectory = recorded(problems, kernel=kernel)[1].trajectory
    assert trajectory.time.shape == trajectory.dwell.shape == (*problems, 11, 4)
    assert trajectory.unsatisfied_weight.shape == (*problems, 11, 4)
    assert trajectory.assignments.shape == (*problems, 11, 4, 7)
    assert trajectory.assignments.dtype == torch.bool


@either_kernel
def test_dwell_times_add_up_to_the_time(kernel):
    trajectory = recorded(kernel=kernel)[1].trajectory
    assert (trajectory.dwell > 0).all()
    torch.testing.assert_close(trajectory.dwell.cumsum(-1), trajectory.time, rtol=1e-12, atol=0)


def test_time_is_the_sum_of_the_step_sizes():
    fixed = AdaptiveEuler(change=1.0, dt_min=0.25, dt_max=0.25)
    trajectory = recorded(integrator=fixed)[1].trajectory
    assert trajectory.time.equal(torch.tensor([1.25, 2.5, 3.75, 5.0]).double().expand(2, 11, 4))


@either_kernel
def test_unsatisfied_weight_is_that_of_the_assignments(kernel):
    qubo, solution = recorded(kernel=kernel)
    states = solution.trajectory.assignments.flatten(-3, -2)
    expected = from_qubo(qubo).unsatisfied_weight(states).unflatten(-1, (11, 4))
    torch.testing.assert_close(solution.trajectory.unsatisfied_weight, expected, rtol=1e-5, atol=1e-5)
    assert expected.std() > 0.1


@either_kernel
def test_best_is_the_lowest_of_the_records_when_every_step_is_recorded(kernel):
    qubo, solution = recorded(every=1, kernel=kernel, quench_every=0)
    energies = qubo.energy(solution.trajectory.assignments.flatten(-3, -2)).unflatten(-1, (11, 23))
    assert (solution.energies <= energies.amin(-1)).all()
    assert (solution.energies == energies.amin(-1)).float().mean() > 0.9


@either_kernel
@pytest.mark.parametrize("quench_every", [0, 4])
def test_recording_changes_nothing(kernel, quench_every):
    """But that no restart ends early; records fall on other steps than readings, too."""
    qubo, solution = recorded(kernel=kernel, quench_every=quench_every)
    settings = {"kernel": kernel, "quench_every": quench_every, "stall": None}
    silent = solve(DmmSolver(n_restarts=11, max_steps=23, **settings), qubo)
    assert silent.assignments.equal(solution.assignments)


@either_kernel
def test_restarts_not_run_have_records_of_no_duration(kernel):
    solution = recorded(problems=(2, 3), patience=2, max_steps=101, kernel=kernel)[1]
    not_run = solution.status == Status.NOT_RUN
    assert not_run.any()
    assert (solution.trajectory.dwell.sum(-1) == 0).equal(not_run)


@either_kernel
def test_low_energy_stretch_begins_where_the_weight_first_falls_to_its_median(kernel):
    trajectory = recorded(problems=(2, 3), patience=2, every=3, max_steps=101, kernel=kernel)[1].trajectory
    weights, dwells = (x.flatten(0, 2).tolist() for x in (trajectory.unsatisfied_weight, trajectory.dwell))
    found = trajectory.weights().flatten(0, 2).tolist()
    shortened = 0
    for weight, dwell, ours in zip(weights, dwells, found, strict=True):
        median = sorted(weight)[(len(weight) - 1) // 2]
        begin = next(at for at, x in enumerate(weight) if x <= median)
        assert ours == [0.0] * begin + dwell[begin:]
        shortened += begin > 0
    assert shortened > 0


# --- readout ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("replicas", [(), (2, 3)], ids=str)
@pytest.mark.parametrize("patience", [None, 2])
def test_time_average_weights_each_record_by_its_duration(replicas, patience):
    rbm = small_rbm(replicas=replicas).double()
    solver = DmmSolver(n_restarts=7, patience=patience, max_steps=53, record=Recording(every=3))
    negative = GroundState(solver=solver, readout="time_average").sample(
        rbm, (), positive_phase(rbm, torch.zeros(*replicas, 11, 7).double()), generator=rng.stream(0, "solver")
    )
    trajectory = solve(solver, from_model(rbm)).trajectory
    v, h, weight = negative.configurations
    assert v.shape == (*replicas, 7 * 17, 7)
    assert torch.cat((v, h), -1).equal(trajectory.assignments.flatten(-3, -2).double())
    assert weight.equal(trajectory.weights().flatten(-2))
    qubo = from_model(rbm)
    energies = qubo.energy(torch.cat((v, h), -1))
    average = (energies * weight).sum(-1) / trajectory.weights().sum((-1, -2))
    torch.testing.assert_close(rbm.mean_energy(negative.configurations).detach(), average)


@pytest.mark.parametrize("replicas", [(), (2, 3)], ids=str)
def test_best_readout_is_the_ground_state(replicas):
    rbm = small_rbm(replicas=replicas)
    sampler = GroundState(solver=DmmSolver(n_restarts=11, patience=3, max_steps=211))
    positive = positive_phase(rbm, torch.zeros(*replicas, 11, 7))
    negative = sampler.sample(rbm, (), positive, generator=rng.stream(0, "solver"))
    v, h, weight = negative.configurations
    ground = solve(BruteForce(), from_model(rbm))
    assert weight is None
    assert torch.cat((v, h), -1).equal(ground.best.unsqueeze(-2))
    torch.testing.assert_close(negative.info["ground_state_energy"], ground.best_energy)
    assert (negative.info["restarts_run"] <= 11).all()
    assert (negative.info["restarts_at_best"] > 0).all()
    assert (negative.info["restarts_at_best"] <= 1).all()


def test_diagnostics_count_the_restarts():
    field = ScriptedField([[3, 1, 1, 2, 7, 7, 7]])

    class Scripted:
        def minimise(self, qubo, *, generator):
            solver = DmmSolver(field=field, n_restarts=7, patience=2, max_steps=2, quench_every=0)
            return solver.minimise(field.qubo(), generator=generator)

    rbm = small_rbm(2, 1, replicas=(1,))
    negative = GroundState(solver=Scripted()).sample(
        rbm, (), positive_phase(rbm, torch.zeros(1, 11, 2)), generator=rng.stream(0, "solver")
    )
    assert negative.info["ground_state_energy"].tolist() == [1.0]
    assert negative.info["restarts_run"].tolist() == [4.0]
    assert negative.info["restarts_at_best"].tolist() == [0.5]
