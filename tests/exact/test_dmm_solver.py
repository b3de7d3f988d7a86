"""Optima, stopping rule, records and readout of the DMM solver."""

from typing import NamedTuple

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.dmm import AdaptiveEuler, DmmSolver, Recording
from memcomp_lightning.models import RBM
from memcomp_lightning.objective import contrast
from memcomp_lightning.qubo import BruteForce, Qubo, Status, from_model, from_qubo
from memcomp_lightning.samplers import CD, PCD, GroundState, positive_phase
from memcomp_lightning.testing.conformance import small_rbm


def normal(*shape, seed=0):
    return torch.empty(shape).normal_(generator=rng.stream(seed, "test draws"))


def solve(solver, qubo, seed=0):
    return solver.minimise(qubo, generator=rng.stream(seed, "solver"))


def minimum(qubo):
    return solve(BruteForce(), qubo).best_energy


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
def test_finds_the_optimum_of_random_problems(qubo):
    solution = solve(DmmSolver(n_restarts=13, max_steps=307), qubo)
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
    solution = solve(DmmSolver(n_restarts=28, max_steps=307), qubo)
    torch.testing.assert_close(solution.best_energy, minimum(qubo), rtol=1e-12, atol=1e-12)


def test_energies_are_those_of_the_assignments():
    qubo = from_model(small_rbm(replicas=(2, 3)))
    solution = solve(DmmSolver(n_restarts=5, max_steps=3), qubo)
    assert solution.energies.equal(qubo.energy(solution.assignments))
    assert (solution.energies.amax(-1) > solution.energies.amin(-1)).any()


def test_more_steps_never_give_a_higher_energy():
    qubo = Qubo.from_matrix(normal(3, 11, 11))
    few, many = (solve(DmmSolver(n_restarts=7, max_steps=n), qubo).energies for n in (2, 41))
    assert (many <= few).all()
    assert (many < few).any()


# --- streams and shapes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("patience", [None, 2])
def test_same_stream_gives_the_same_solution_and_another_one_another(patience):
    solver = DmmSolver(n_restarts=5, patience=patience, max_steps=11, record=Recording(every=3))
    qubo = Qubo.from_matrix(normal(3, 11, 11))
    first, again, other = (solve(solver, qubo, seed) for seed in (0, 0, 1))
    assert first.assignments.equal(again.assignments)
    assert first.energies.equal(again.energies)
    assert first.status.equal(again.status)
    assert all(a.equal(b) for a, b in zip(first.trajectory, again.trajectory, strict=True))
    assert not first.trajectory.time.equal(other.trajectory.time)


@pytest.mark.parametrize("problems", [(), (1,), (3,), (2, 3)], ids=str)
def test_shapes(problems):
    qubo = Qubo.from_matrix(normal(*problems, 7, 7))
    solution = solve(DmmSolver(n_restarts=5, max_steps=11), qubo)
    assert solution.assignments.shape == (*problems, 5, 7)
    assert solution.energies.shape == solution.status.shape == solution.steps.shape == (*problems, 5)
    assert solution.best.shape == (*problems, 7)
    assert solution.best_energy.shape == problems
    assert solution.trajectory is None
    assert solution.assignments.dtype == qubo.linear.dtype


def test_single_problem_equals_a_batch_of_one():
    matrix, solver = normal(7, 7), DmmSolver(n_restarts=5, max_steps=23)
    single, batch = solve(solver, Qubo.from_matrix(matrix)), solve(solver, Qubo.from_matrix(matrix[None]))
    assert single.assignments.equal(batch.assignments[0])
    assert single.energies.equal(batch.energies[0])


# --- stopping rule ----------------------------------------------------------------------------------------


class Voltages(NamedTuple):
    voltage: torch.Tensor


class ScriptedField:
    """Restart r of problem p stays at the assignment that reads ``table[p][r]`` in binary.

    The problem is known by its unit clauses, which the script's QUBO numbers.
    """

    def __init__(self, table):
        self.table = torch.tensor(table)
        self.done = 0

    def qubo(self):
        number = torch.arange(1.0, len(self.table) + 1)
        linear = number[:, None] * torch.tensor([4.0, 2.0, 1.0])
        pair = torch.zeros(len(self.table), 3, 3)
        return Qubo.from_matrix(torch.diag_embed(linear) + pair)

    def build(self, maxsat):
        return (-maxsat.unit[:, 2] - 1).long()

    def init(self, machine, n_restarts, *, generator):
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
    solution = solve(DmmSolver(field=field, n_restarts=7, patience=patience, max_steps=2), field.qubo())
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
    solution = solve(DmmSolver(field=field, n_restarts=7, max_steps=2), field.qubo())
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

    def init(self, machine, n_restarts, *, generator):
        return Voltages(torch.full((1, n_restarts, 1), -0.95))

    def build(self, maxsat):
        return None

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
    steady = AdaptiveEuler(max_change=1.0, dt_min=0.1, dt_max=0.1)
    solver = DmmSolver(field=field, integrator=steady, n_restarts=3, max_steps=max_steps)
    solution = solve(solver, field.qubo())
    assert (solution.status == status).all()
    assert (solution.energies == energy).all()


# --- records ----------------------------------------------------------------------------------------------


def recorded(problems=(2,), every=5, max_steps=23, **settings):
    qubo = Qubo.from_matrix(normal(*problems, 7, 7), offset=normal(*problems, seed=1))
    solver = DmmSolver(n_restarts=11, max_steps=max_steps, record=Recording(every=every), **settings)
    return qubo, solve(solver, qubo)


@pytest.mark.parametrize("problems", [(), (2,), (2, 3)], ids=str)
def test_record_shapes(problems):
    trajectory = recorded(problems)[1].trajectory
    assert trajectory.time.shape == trajectory.dwell.shape == (*problems, 11, 4)
    assert trajectory.unsatisfied_weight.shape == (*problems, 11, 4)
    assert trajectory.assignments.shape == (*problems, 11, 4, 7)
    assert trajectory.assignments.dtype == torch.bool


def test_dwell_times_add_up_to_the_time():
    trajectory = recorded()[1].trajectory
    assert (trajectory.dwell > 0).all()
    torch.testing.assert_close(trajectory.dwell.cumsum(-1), trajectory.time, rtol=1e-12, atol=0)


def test_time_is_the_sum_of_the_step_sizes():
    fixed = AdaptiveEuler(max_change=1.0, dt_min=0.25, dt_max=0.25)
    trajectory = recorded(integrator=fixed)[1].trajectory
    assert trajectory.time.equal(torch.tensor([1.25, 2.5, 3.75, 5.0]).double().expand(2, 11, 4))


def test_unsatisfied_weight_is_that_of_the_assignments():
    qubo, solution = recorded()
    states = solution.trajectory.assignments.flatten(-3, -2)
    expected = from_qubo(qubo).unsatisfied_weight(states).unflatten(-1, (11, 4))
    torch.testing.assert_close(solution.trajectory.unsatisfied_weight, expected, rtol=1e-5, atol=1e-5)
    assert expected.std() > 0.1


def test_best_is_the_lowest_of_the_records_when_every_step_is_recorded():
    qubo, solution = recorded(every=1)
    energies = qubo.energy(solution.trajectory.assignments.flatten(-3, -2)).unflatten(-1, (11, 23))
    assert (solution.energies <= energies.amin(-1)).all()
    assert (solution.energies == energies.amin(-1)).float().mean() > 0.9


def test_recording_changes_nothing():
    qubo, solution = recorded()
    silent = solve(DmmSolver(n_restarts=11, max_steps=23), qubo)
    assert silent.assignments.equal(solution.assignments)


def test_restarts_not_run_have_records_of_no_duration():
    solution = recorded(problems=(2, 3), patience=2, max_steps=101)[1]
    not_run = solution.status == Status.NOT_RUN
    assert not_run.any()
    assert (solution.trajectory.dwell.sum(-1) == 0).equal(not_run)


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
    assert weight.equal(trajectory.dwell.flatten(-2))
    qubo = from_model(rbm)
    energies = qubo.energy(torch.cat((v, h), -1))
    average = (energies * weight).sum(-1) / trajectory.dwell.sum((-1, -2))
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
            solver = DmmSolver(field=field, n_restarts=7, patience=2, max_steps=2)
            return solver.minimise(field.qubo(), generator=generator)

    rbm = small_rbm(2, 1, replicas=(1,))
    negative = GroundState(solver=Scripted()).sample(
        rbm, (), positive_phase(rbm, torch.zeros(1, 11, 2)), generator=rng.stream(0, "solver")
    )
    assert negative.info["ground_state_energy"].tolist() == [1.0]
    assert negative.info["restarts_run"].tolist() == [4.0]
    assert negative.info["restarts_at_best"].tolist() == [0.5]
