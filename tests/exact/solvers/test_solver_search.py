"""Rounds of a solver: when they end, what is kept of them, and what they say together."""

import itertools
import math
import signal
import threading
from dataclasses import dataclass

import numpy as np
import pytest

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.problems import Constrained, Qubo, WeightedMaxSat, exactly, read_problem
from memcomp_lightning.solvers import (
    AlternatingDescent,
    BranchAndBound,
    BruteForce,
    GibbsAnnealing,
    Portfolio,
    QuboSolution,
    Search,
    Status,
    TabuSearch,
    search,
)
from memcomp_lightning.solvers.dmm import DmmSolver, Recording
from memcomp_lightning.solvers.found import PROVEN, Found, State


def dense(n, name="dense"):
    return Qubo.from_matrix(rng.numpy_stream(0, name).normal(size=(n, n)))


def glass(n):
    """Couplings of spins without fields, whose roof dual is far below all energies."""
    bonds = np.triu(rng.numpy_stream(0, "glass").normal(size=(n, n)), 1)
    return Qubo.from_matrix(4 * bonds - 2 * np.diag((bonds + bonds.T).sum(0)))


def lowest(qubo):
    return qubo.energy(binary_states(qubo.n, like=qubo.linear)).min()


@pytest.mark.parametrize("solver", [GibbsAnnealing(), TabuSearch(), DmmSolver(), AlternatingDescent()])
def test_without_a_limit_it_is_one_call_of_the_solver(solver):
    qubo = dense(14)
    found = Search().run(qubo, solver, seed=3)
    alone = solver.minimise(qubo, generator=rng.numpy_stream(3, "solver"))
    assert found.energies == alone.energies.tolist()
    assert found.status == alone.status.tolist()
    assert found.steps == alone.steps.tolist()
    assert np.array_equal(found.states[0].values, alone.best > 0.5)
    assert [energy for _, energy in found.curve] == [found.states[0].energy] == pytest.approx([alone.best_energy])


class Clock:
    """Stands still unless a solver says how long it takes."""

    def __init__(self):
        self.now = 0.0

    def perf_counter(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(search, "time", clock)
    return clock


@dataclass(frozen=True)
class Slow:
    """A step takes a second; each round sets one more variable of ``x' 1 x`` to 0."""

    clock: Clock
    n_steps: int = 1
    lengths: list[int] | None = None

    def minimise(self, qubo, *, generator):
        self.clock.now += self.n_steps
        self.lengths.append(self.n_steps)
        x = np.ones((2, qubo.n))
        x[:, : len(self.lengths)] = 0
        steps = np.full(2, self.n_steps)
        return QuboSolution(x, qubo.energy(x), np.full(2, int(Status.STEP_BUDGET)), steps, 0.0)


ONES = Qubo.from_matrix(np.ones((14, 14)))


@pytest.mark.parametrize(
    ("limit", "lengths"),
    [(0.5, [1]), (1.05, [1]), (2, [1, 1]), (7, [1, 2, 4]), (13, [1, 2, 4, 6]), (7.3, [1, 2, 4])],
)
def test_rounds_double_until_the_time_is_up(clock, limit, lengths):
    solver = Slow(clock, lengths=[])
    found = Search(time_limit=limit).run(ONES, solver)
    assert solver.lengths == lengths
    assert found.wall_time_s == sum(lengths)
    n = len(lengths)
    assert [energy for _, energy in found.curve] == [(14 - k) ** 2 for k in range(1, n + 1)]
    assert [seconds for seconds, _ in found.curve] == np.cumsum(lengths).tolist()
    assert found.energies == [(14 - k) ** 2 for k in range(1, n + 1) for _ in range(2)]


@pytest.mark.parametrize(("target", "n_rounds"), [(100, 4), (99.5, 5), (169, 1), (np.float64(145), 2)])
def test_a_target_ends_it(clock, target, n_rounds):
    solver = Slow(clock, lengths=[])
    assert Search(target=target).run(ONES, solver).states[0].energy == (14 - n_rounds) ** 2
    assert Search(target=target, time_limit=2).run(ONES, Slow(clock, lengths=[])).states[0].energy >= 144


def test_initial_states_may_meet_the_target(clock):
    solver = Slow(clock, lengths=[])
    found = Search(target=1).run(ONES, solver, initial=np.eye(14)[:3] > 0)
    assert solver.lengths == []
    assert found.states[0].energy == 1
    assert (found.energies, found.conclusion) == ([], Status.STEP_BUDGET)


@pytest.mark.parametrize(
    ("solver", "longer"),
    [
        (Portfolio(effort=0.5), Portfolio(effort=1.0)),
        (GibbsAnnealing(n_sweeps=30), GibbsAnnealing(n_sweeps=60)),
        (TabuSearch(), TabuSearch(n_steps=20)),
        (TabuSearch(n_steps=7), TabuSearch(n_steps=14)),
        (DmmSolver(record=Recording()), DmmSolver(max_steps=20)),
        (BranchAndBound(max_nodes=5), BranchAndBound(max_nodes=10)),
        (AlternatingDescent(), AlternatingDescent()),
    ],
)
def test_the_setting_that_says_how_long_a_restart_takes_grows(solver, longer):
    assert search._longer(solver, 2.0, 10) == longer


def test_a_real_time_limit_is_kept():
    Search().run(dense(100), Portfolio())  # compiles
    found = Search(time_limit=0.4).run(dense(100), Portfolio())
    assert found.wall_time_s < 10  # of a machine that may have other things to do
    assert len(found.energies) >= 28


def test_a_proof_ends_it():
    for solver in (BruteForce(), Portfolio()):
        found = Search(time_limit=1000).run(dense(11), solver)
        assert (found.conclusion, len(found.energies)) == (Status.OPTIMAL, 1)
        assert found.lower_bound == found.states[0].energy == pytest.approx(lowest(dense(11)))
    ring = Qubo.from_coo(40, np.arange(40), (np.arange(40) + 1) % 40, np.ones(40) - 2 * (np.arange(40) % 3 == 0))
    found = Search(target=-1e9).run(ring, Portfolio())
    assert (found.conclusion, found.steps) == (Status.OPTIMAL, [40])


def test_a_bound_that_is_met_is_a_proof():
    """A complete graph of negative couplings: not of treewidth two, but all variables at 1 meet the roof dual."""
    pytest.importorskip("dwave.preprocessing")
    found = Search(time_limit=1000).run(Qubo.from_matrix(-np.ones((15, 15))), TabuSearch(n_restarts=1))
    assert (found.conclusion, found.lower_bound, found.states[0].energy) == (Status.OPTIMAL, -225, -225)


class Interrupted:
    """Ctrl-C comes in a round."""

    def __init__(self, during):
        self.left = during

    def minimise(self, qubo, *, generator):
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt
        return AlternatingDescent(n_restarts=3).minimise(qubo, generator=generator)


def test_ctrl_c_returns_the_best_so_far():
    found = Search(target=-1e9).run(glass(14), Interrupted(3))
    assert len(found.energies) == 6
    assert found.states[0].energy == pytest.approx(min(found.energies))
    start = np.zeros((1, 14), np.bool_)
    assert Search().run(glass(14), Interrupted(1), initial=start).states[0].energy <= 0
    with pytest.raises(KeyboardInterrupt):
        Search().run(glass(14), Interrupted(1))


ENDLESS = [TabuSearch(n_steps=2**29 - 1), GibbsAnnealing(n_sweeps=10**7), Portfolio(effort=1e3)]


@pytest.mark.parametrize("solver", ENDLESS, ids=lambda solver: type(solver).__name__)
def test_a_round_that_takes_too_long_is_ended(solver):
    found = Search(time_limit=0.3).run(dense(150), solver)
    assert found.wall_time_s < 30
    assert Status.STOPPED in found.status
    lowest_of_all = min(energy for energy in found.energies if energy is not None)
    assert found.states[0].energy == pytest.approx(lowest_of_all)
    within_a_moment = Search(time_limit=1e-9, n_solutions=2).run(dense(150), solver)
    assert within_a_moment.states, "something is always returned"


@pytest.mark.parametrize("solver", ENDLESS, ids=lambda solver: type(solver).__name__)
def test_ctrl_c_in_a_compiled_search_returns_the_best_so_far(solver):
    qubo, start = dense(150), np.zeros((1, 150), np.bool_)
    Search(time_limit=0.3).run(qubo, solver, initial=start)  # compiles
    timer = threading.Timer(0.5, signal.pthread_kill, (threading.get_ident(), signal.SIGINT))
    timer.start()
    found = Search().run(qubo, solver, initial=start)
    timer.join()
    assert found.interrupted
    assert found.states[0].energy < 0


def test_initial_states_are_improved_on():
    qubo = dense(60)
    best = Search().run(qubo, Portfolio()).states[0]
    near = best.values.copy()
    near[:3] = ~near[:3]
    weak = AlternatingDescent(n_restarts=1, max_sweeps=1)
    found = Search().run(qubo, weak, initial=np.stack((np.zeros(60, np.bool_), near)))
    assert found.states[0].energy == pytest.approx(best.energy)
    assert found.energies > [best.energy], "not the restart, the initial state led there"


def test_ctrl_c_in_a_callback_returns_what_it_was_called_with():
    told = []

    def interrupt(state):
        told.append(state)
        raise KeyboardInterrupt

    found = Search(target=-1e9).run(glass(14), AlternatingDescent(), callback=interrupt)
    assert [state.energy for state in told] == [found.states[0].energy]
    assert len(found.energies) == 28


@pytest.mark.parametrize("distance", [1, 2, 4])
def test_of_a_small_problem_the_lowest_states_are_found(distance):
    qubo = dense(9)
    found = Search(n_solutions=20, min_distance=distance).run(qubo, Portfolio())
    x = binary_states(9, like=qubo.linear)
    expected = []
    for k in qubo.energy(x).argsort():
        if len(expected) < 20 and all((x[k] != x[other]).sum() >= distance for other in expected):
            expected.append(k)
    np.testing.assert_array_equal([state.values for state in found.states], x[expected] > 0.5)
    assert [state.energy for state in found.states] == pytest.approx(qubo.energy(x)[expected].tolist())


@pytest.mark.parametrize("solver", [Portfolio(), AlternatingDescent(), DmmSolver(n_restarts=2)])
@pytest.mark.parametrize("distance", [1, 5])
def test_solutions_differ_as_asked(solver, distance):
    qubo = dense(40)
    found = Search(n_solutions=15, min_distance=distance).run(qubo, solver)
    x = np.array([state.values for state in found.states])
    apart = (x[:, None] != x).sum(-1)[~np.eye(len(x), dtype=bool)]
    assert apart.min() >= distance
    assert 2 <= len(x) <= 15
    energies = [state.energy for state in found.states]
    np.testing.assert_allclose(qubo.energy(x.astype(float)), energies)
    assert energies == sorted(energies)
    assert energies[0] <= min(found.energies) + 1e-9


def test_clauses_of_three_literals(tmp_path):
    clauses = [[1, 2, 3], [-1, -2, -3], [1, -2, 4], [-4, 2, -3]]
    problem = WeightedMaxSat.from_clauses(4, clauses, [1, 2, 3, 4])
    found = Search(n_solutions=5).run(problem, DmmSolver())
    assert [state.energy for state in found.states] == [0] * 5
    (tmp_path / "a.cnf").write_text("p cnf 4 4\n" + "".join(f"{' '.join(map(str, c))} 0\n" for c in clauses))
    assert Search(target=0).run(read_problem(tmp_path / "a.cnf"), DmmSolver()).states[0].energy == 0


@pytest.mark.parametrize("solver", [Portfolio(), DmmSolver(), BruteForce()])
def test_constraints_come_before_energies(solver):
    """The three lowest of four numbers: any two of them."""
    objective = Qubo.from_matrix(np.diag([-3.0, -2.0, -1.0, 5.0]))
    problem = Constrained.of(objective, [exactly(2, range(4))])
    told = []
    found = Search(n_solutions=20).run(problem, solver, callback=told.append)
    assert [state.energy for state in found.states] == [-5, -4, -3, 2, 3, 4]
    assert {state.n_broken for state in [*found.states, *told]} == {0}
    assert found.curve[-1][1] == -5
    start = np.array([[True, True, True, False]])  # less energy, but it breaks the constraint
    assert Search().run(problem, solver, initial=start).states[0].energy == -5
    assert Search(target=-3.5, time_limit=1000).run(problem, solver, initial=start).states[0].energy <= -4
    impossible = Constrained.of(objective, [exactly(2, range(4)), exactly(1, range(4))])
    found = Search(n_solutions=3).run(impossible, solver)
    assert (found.curve, len(found.states), found.states[0].n_broken) == ([], 1, 1)
    assert found.conclusion in (Status.INFEASIBLE, Status.NOT_FEASIBLE)


def test_a_files_energies_and_targets_are_exact(tmp_path):
    (tmp_path / "a.coo").write_text("".join(f"{i} {j} -0.1\n" for i in range(13) for j in range(i)))
    problem = read_problem(tmp_path / "a.coo")
    found = Search(target=-7.8).run(problem, AlternatingDescent(n_restarts=1))
    assert found.states[0].energy * 10 == -78
    assert found.energies[-1] == found.states[0].energy


def ended(energies, status=(), best=None, **settings):
    status = [*status, *[Status.STEP_BUDGET] * (len(energies) - len(status))]
    best = min(energy for energy in energies if energy is not None) if best is None else best
    restarts = {"energies": energies, "broken": [0] * len(energies), "status": status, "steps": []}
    restarts["population"] = list(range(len(energies)))
    return Found(states=[State(None, best, 0.0)], curve=[], **{**restarts, **settings})


@pytest.mark.parametrize(
    ("found", "conclusion", "reached"),
    [
        (ended([1.0, 1.0, 1.0]), Status.AGREED, 3),
        (ended([1.0, 1.0]), Status.STEP_BUDGET, 2),
        (ended([1.0] * 3 + [2.0] * 3), Status.AGREED, 3),
        (ended([1.0] * 3 + [2.0] * 3 + [None] * 5), Status.AGREED, 3),
        (ended([1.0] * 3 + [2.0] * 4), Status.STEP_BUDGET, 3),
        (ended([1.0] * 3, best=0.5), Status.STEP_BUDGET, 0),
        (ended([1.0] * 9, population=[0] * 9), Status.STEP_BUDGET, 9),
        (ended([1.0] * 9, population=[0] * 8 + [1]), Status.AGREED, 9),
        (ended([1.0] * 8 + [2.0], population=[0] * 7 + [1, 2]), Status.AGREED, 8),
        (ended([1.0] * 8 + [2.0], population=[0] * 8 + [1]), Status.STEP_BUDGET, 8),
        (ended([1.0, 1.0], population=[0, 1]), Status.STEP_BUDGET, 2),
        (ended([1.0] * 5, [Status.CONVERGED] * 3), Status.CONVERGED, 5),
        (ended([1.0] * 5, [Status.CONVERGED] * 2), Status.AGREED, 5),
        (ended([1.0, 1.0 + 1e-9, 1.0], resolution=1e-8), Status.AGREED, 3),
        (ended([1.0, 1.0 + 1e-9, 1.0]), Status.STEP_BUDGET, 2),
        (ended([2.0, 1.0, 3.0], [Status.CONVERGED, Status.STILL_IMPROVING]), Status.STILL_IMPROVING, 1),
        (ended([1.0, 1.0, 1.0], [Status.CONVERGED, Status.OPTIMAL]), Status.OPTIMAL, 3),
        (ended([1.0, 2.0], [Status.CONVERGED, Status.ROUNDED]), Status.CONVERGED, 1),
        (ended([5], [Status.INFEASIBLE]), Status.INFEASIBLE, 1),
        (ended([3.0], lower_bound=2.5, resolution=0.75), Status.OPTIMAL, 1),
        (ended([1.0] * 3, [Status.NOT_FEASIBLE] * 3, broken=[0, 1, 1]), Status.NOT_FEASIBLE, 1),
        (ended([3.0], lower_bound=2.0, resolution=0.75), Status.STEP_BUDGET, 1),
    ],
)
def test_what_restarts_say_together(found, conclusion, reached):
    assert (found.conclusion, found.n_reached) == (conclusion, reached)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"time_limit": 0}, "time_limit = 0 is not allowed: expected seconds > 0"),
        ({"time_limit": math.inf}, "time_limit = inf"),
        ({"time_limit": "10"}, "time_limit = '10'"),
        ({"time_limit": True}, "time_limit = True"),
        ({"target": math.nan}, "target = nan is not allowed: expected a finite number"),
        ({"n_solutions": 0}, "n_solutions = 0"),
        ({"min_distance": 1.5}, "min_distance = 1.5"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(SettingError, match=message):
        Search(**settings)


def test_several_problems_are_refused():
    with pytest.raises(SettingError, match=r"problems = \(2,\)"):
        Search().run(Qubo.from_matrix(np.ones((2, 3, 3))), Portfolio())


def test_memory_that_runs_out_is_said():
    class Hungry:
        n_restarts = 7

        def minimise(self, qubo, *, generator):
            raise MemoryError

    with pytest.raises(UserError, match=r"^14 variables, 91 couplings. Hungry with solver.n_restarts = 7 needs"):
        Search().run(ONES, Hungry())


def test_a_large_number_makes_no_proof_and_no_agreement():
    generator = rng.numpy_stream(0, "large")
    matrix = generator.normal(size=(16, 16))
    matrix[0, 0] = 5e12
    qubo = Qubo.from_matrix(matrix)
    minimum = BruteForce().minimise(qubo, generator=generator).best_energy
    found = Search().run(qubo, TabuSearch(n_restarts=1, n_steps=1))
    assert found.states[0].energy > minimum + 1
    assert found.conclusion not in PROVEN


def test_the_curve_of_decimal_fractions_falls(tmp_path):
    lines = [f"{i} {j} 0.1" for i in range(18) for j in range(i)] + [f"{i} {i} -0.3" for i in range(18)]
    (tmp_path / "decimal.coo").write_text("\n".join(lines))
    found = Search(n_solutions=4).run(read_problem(tmp_path / "decimal.coo"), Portfolio())
    energies = [energy for _, energy in found.curve]
    assert all(after < before for before, after in itertools.pairwise(energies))
