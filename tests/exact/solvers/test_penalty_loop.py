"""Constraints by solvers that know none: against enumeration, and what a repair may not do."""

import random
import time

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import (
    Bipartite,
    Constrained,
    Linear,
    Qubo,
    WeightedMaxSat,
    as_qubo,
    clause,
    exactly,
)
from memcomp_lightning.solvers import (
    AlternatingDescent,
    BruteForce,
    GibbsAnnealing,
    PenaltyLoop,
    Portfolio,
    QuboSolution,
    Search,
    Status,
    TabuSearch,
    constrained,
    groups,
)
from memcomp_lightning.solvers.constrained import gains, local_penalties, safe_penalty
from memcomp_lightning.solvers.dmm import BondField, DmmSolver
from memcomp_lightning.solvers.repair import repair

SOLVERS = {
    "brute force": BruteForce(),
    "descent": AlternatingDescent(n_restarts=40),
    "annealing": GibbsAnnealing(n_restarts=20, n_sweeps=60),
    "tabu": TabuSearch(n_restarts=12, n_steps=300),
    "best": Portfolio(n_restarts=16),
    "clauses": DmmSolver(n_restarts=20),
    "bonds": DmmSolver(field=BondField(), n_restarts=20),
}
LIKE = {"numpy": np.zeros(0), "torch": torch.zeros(0)}
N = 7


def random_problem(seed, *, problems=()):
    """Clauses, exactly k and linear bounds over seven variables, in turn alone and together."""
    draw = random.Random(seed)
    rows, kinds = [], ["clause", "exactly", "linear"]
    kind = [*kinds, None][seed % 4]
    for _ in range(draw.randint(1, 5)):
        chosen = draw.sample(range(N), draw.randint(1, 4))
        this = kind or draw.choice(kinds)
        if this == "clause":
            rows.append(clause(draw.choice([-1, 1]) * (i + 1) for i in chosen))
        elif this == "exactly":
            rows.append(exactly(draw.randint(0, min(2, len(chosen))), chosen))
        else:
            a = {i: draw.choice([-2, -1, 1, 2]) for i in chosen}
            rows.append(Linear(a, *draw.choice([(0, 1), (None, 1), (0, None), (1, 1)])))
    if seed % 3 == 0 and not problems:
        clauses = [[draw.choice([-1, 1]) * i for i in draw.sample(range(1, N + 1), k)] for k in (1, 1, 2, 2, 3, 4)]
        objective = WeightedMaxSat.from_clauses(N, clauses, [draw.randint(1, 9) for _ in clauses])
    else:
        entries = np.random.default_rng(seed).integers(-5, 6, (*problems, N, N))
        objective = Qubo.from_matrix(entries.astype(np.float64))
    return Constrained.of(objective, rows)


def ranks(problem):
    """Broken constraints and objective of every state, ``(*problems, 2^N)`` each."""
    states = binary_states(N, like=np.zeros(0))
    states = np.broadcast_to(states, (*problem.objective.problems, *states.shape))
    return problem.n_broken(states), problem.energy(states)


@pytest.mark.parametrize("like", LIKE)
@pytest.mark.parametrize("name", SOLVERS)
def test_the_answer_is_the_best_of_those_that_keep_all_constraints(name, like):
    n_exact, seeds = 0, range(24 if like == "numpy" else 12)
    for seed in seeds:
        problem = random_problem(seed)
        broken, energies = ranks(problem)
        given = Constrained(problem.objective.alike(LIKE[like]), problem.constraints)
        solution = PenaltyLoop(solver=SOLVERS[name]).minimise(given, generator=rng.numpy_stream(seed, "solver"))
        assert type(solution.assignments) is type(LIKE[like])
        assert solution.broken.tolist() == problem.n_broken(to_numpy(solution.assignments)).tolist()
        np.testing.assert_allclose(to_numpy(solution.energies), problem.energy(to_numpy(solution.assignments)))
        fewest = int(problem.n_broken(to_numpy(solution.best)[None])[0])
        assert fewest == int(solution.broken.min())
        assert (fewest == 0) == (broken.min() == 0), f"seed {seed}: there is a state that keeps all constraints"
        status = set(solution.status.tolist())
        if broken.min() > 0:
            assert status <= {Status.NOT_FEASIBLE, Status.INFEASIBLE}
            assert name != "brute force" or Status.INFEASIBLE in status
            continue
        lowest = energies[broken == 0].min()
        n_exact += float(solution.best_energy) == pytest.approx(lowest)
        if Status.OPTIMAL in status:
            proven = to_numpy(solution.energies)[to_numpy(solution.status) == int(Status.OPTIMAL)]
            assert proven.min() == pytest.approx(lowest)
            assert Status.INFEASIBLE not in status
        assert name != "brute force" or Status.OPTIMAL in status
    n_feasible = sum(ranks(random_problem(seed))[0].min() == 0 for seed in seeds)
    assert len(seeds) / 2 < n_feasible < len(seeds)
    assert n_exact == n_feasible if name == "brute force" else n_exact >= n_feasible - 1


@pytest.mark.parametrize("like", LIKE)
def test_a_repair_breaks_nothing_and_ends_where_no_flip_helps(like):
    for seed in range(40):
        problem = random_problem(seed)
        given = Constrained(problem.objective.alike(LIKE[like]), problem.constraints)
        states = binary_states(N, like=given.objective.offset)
        found = repair(given, states)
        assert type(found) is type(states)
        before, after = given.n_broken(states).tolist(), given.n_broken(found).tolist()
        assert all(b <= a for a, b in zip(before, after, strict=True))
        kept = to_numpy(given.n_broken(states)) == 0
        assert (to_numpy(given.energy(found))[kept] <= to_numpy(given.energy(states))[kept] + 1e-9).all()
        assert repair(given, found).tolist() == found.tolist()
        for i in range(N):
            flipped = to_numpy(found).copy()
            flipped[:, i] = 1 - flipped[:, i]
            of_flipped, of_found = problem.n_broken(flipped), problem.n_broken(to_numpy(found))
            assert (of_flipped >= of_found).all()
            cheaper = problem.energy(flipped) < problem.energy(to_numpy(found)) - 1e-6
            assert not (cheaper & (of_found == 0) & (of_flipped == 0)).any()


def test_a_repair_of_single_precision_ends():
    entries = np.random.default_rng(0).normal(size=(60, 60)).astype(np.float32)
    problem = Constrained.of(Qubo.from_matrix(entries), [clause([i, i + 1]) for i in range(1, 60)])
    states = np.random.default_rng(1).integers(0, 2, (200, 60)).astype(np.float32)
    assert (problem.n_broken(repair(problem, states)) <= problem.n_broken(states)).all()


def test_an_objective_of_whole_numbers():
    entries = np.random.default_rng(0).integers(-5, 6, (N, N))
    rows = [exactly(2, range(N))]
    whole, real = (Constrained.of(Qubo.from_matrix(q), rows) for q in (entries, entries.astype(np.float64)))
    found = PenaltyLoop(solver=SOLVERS["tabu"]).minimise(whole, generator=rng.numpy_stream(0, "solver"))
    broken, energies = ranks(real)
    assert float(found.best_energy) == energies[broken == 0].min()


def test_what_shares_nothing_is_mended_in_one_pass(monkeypatch):
    """A thousand broken pairs, side by side: as many steps as one."""
    rows = [exactly(1, [2 * k, 2 * k + 1]) for k in range(1000)]
    diagonal = np.arange(2000)
    problem = Constrained.of(Qubo.from_coo(2000, diagonal, diagonal, np.tile([1.0, 2.0], 1000)), rows)
    passes = []
    sums = type(problem.constraints).sums
    monkeypatch.setattr(type(problem.constraints), "sums", lambda *given: passes.append(0) or sums(*given))
    found = repair(problem, np.zeros((3, 2000)))
    assert found.tolist() == [[1.0, 0.0] * 1000] * 3, "the cheaper one of each pair"
    assert len(passes) == 2


# ------------------------------------------------------------------------------------- exactly one of each group


GROUPS = [[0, 3, 6], [5, 2], [8, 1]]


def grouped(name, problems=(), seed=0):
    """Variables of which most are in groups, coupled in all pairs or in two layers that share the groups out."""
    draw = np.random.default_rng(seed)
    if name == "all pairs":
        objective = Qubo.from_matrix(draw.normal(size=(*problems, 10, 10)))
        return Constrained.of(objective, [exactly(1, group) for group in GROUPS])
    coupling, linear = draw.normal(size=(*problems, 4, 7)), draw.normal(size=(*problems, 11))
    layers = [[0, 1], [3, 4], [7, 8]]
    objective = Qubo(Bipartite(7, 4), coupling, linear, np.zeros(problems))
    return Constrained.of(objective, [exactly(1, group) for group in layers])


def states_of(problem):
    """All states that keep the constraints, ``(n, n_variables)``, in numpy."""
    x = binary_states(problem.n, like=np.zeros(0))
    return x[problem.n_broken(x) == 0]


EITHER = pytest.mark.parametrize("name", ["all pairs", "two layers"])


@EITHER
@pytest.mark.parametrize("like", LIKE)
@pytest.mark.parametrize("solver", ["brute force", "annealing", "tabu", "best", "bonds"])
def test_with_one_of_each_group_the_answer_is_the_best_of_all(name, solver, like):
    for problems in ((), (2, 3)):
        problem = grouped(name, problems)
        x = np.broadcast_to(states_of(problem), (*problems, *states_of(problem).shape))
        given = Constrained(problem.objective.alike(LIKE[like]), problem.constraints)
        found = PenaltyLoop(solver=SOLVERS[solver]).minimise(given, generator=rng.numpy_stream(0, "solver"))
        np.testing.assert_allclose(found.best_energy, problem.energy(x).min(-1))
        assert type(found.assignments) is type(LIKE[like])
        proven = to_numpy(found.status == int(Status.OPTIMAL)).any(-1)
        assert solver != "brute force" or proven.all()


@EITHER
@pytest.mark.parametrize("problems", [(), (2, 3)], ids=str)
def test_descents_end_where_no_move_within_a_group_and_no_flip_is_cheaper(name, problems):
    problem = grouped(name, problems)
    table = groups.groups_of(problem)
    x = np.broadcast_to(states_of(problem), (*problems, *states_of(problem).shape))
    found = groups.descend(problem.objective, table, x)
    assert (problem.n_broken(found) == 0).all()
    before, after = problem.energy(x), problem.energy(found)
    assert (after <= before + 1e-9).all()
    assert len(np.unique(found.reshape(-1, problem.n), axis=0)) < x[..., 0].size / 4
    others = [i for i in range(problem.n) if i not in table]
    moves = [(group, on) for row in table for group in [row[row >= 0]] for on in group]
    moves += [([i], on) for i in others for on in (i, None)]
    for group, on in moves:
        moved = found.copy()
        moved[..., group] = 0
        if on is not None:
            moved[..., on] = 1
        assert (problem.energy(moved) >= after - 1e-6).all()
    drawn = groups.guides(problem.objective, table, rng.numpy_stream(0, "solver"))
    assert (problem.n_broken(drawn) == 0).all()
    assert groups.descend(problem.objective, table, drawn).tolist() == drawn.tolist()


@EITHER
def test_guides_begin_at_random_states_that_keep_the_constraints(name, monkeypatch):
    problem = grouped(name, (2, 3))
    monkeypatch.setattr(groups, "descend", lambda qubo, groups, x: x)
    drawn = groups.guides(problem.objective, groups.groups_of(problem), rng.numpy_stream(0, "solver"))
    assert drawn.shape == (2, 3, groups.N_GUIDES, problem.n)
    assert (problem.n_broken(drawn) == 0).all()
    assert ((drawn.mean(-2) > 0) & (drawn.mean(-2) < 1)).all()


@EITHER
def test_answers_end_where_no_move_within_a_group_is_cheaper(name):
    class Drawn:
        def minimise(self, qubo, *, generator):
            x = generator.integers(0, 2, (9, qubo.n)).astype(float)
            status = np.full(9, int(Status.STEP_BUDGET))
            return QuboSolution(x, qubo.energy(x), status, status, 0.0)

    for seed in range(4):
        problem = grouped(name, seed=seed)
        generator = rng.numpy_stream(seed, "solver")
        found = PenaltyLoop(solver=Drawn(), n_turns=1).minimise(problem, generator=generator)
        again = groups.descend(problem.objective, groups.groups_of(problem), found.assignments)
        assert again.tolist() == found.assignments.tolist()
        assert found.energies.tolist() == problem.energy(found.assignments).tolist()


@EITHER
@pytest.mark.parametrize("problems", [(), (2, 3)], ids=str)
def test_a_shift_changes_no_energy_and_small_penalties_suffice(name, problems):
    problem = grouped(name, problems)
    x = np.broadcast_to(states_of(problem), (*problems, *states_of(problem).shape))
    table = groups.groups_of(problem)
    objective, penalties = groups.shifted(problem.objective, table, x)
    np.testing.assert_allclose(objective.energy(x), problem.energy(x), atol=1e-9)
    # Read from all states: no flip of a variable of a group, at any of them, lowers the energy with penalties.
    qubo = Constrained(objective, problem.constraints).penalised(penalties)
    field = qubo.field(x)[..., table[table >= 0]]
    assert (np.where(x[..., table[table >= 0]] > 0, -field, field) > 0).all()
    unshifted = problem.penalised(penalties).field(x)[..., table[table >= 0]]
    assert (np.where(x[..., table[table >= 0]] > 0, -unshifted, unshifted) < 0).any()


def test_without_couplings_the_cheapest_of_each_group_is_chosen():
    problem = Constrained.of(Qubo.from_matrix(np.diag([3.0, -1.0, 2.0, -2.0])), [exactly(1, [0, 1, 2])])
    found = PenaltyLoop(solver=SOLVERS["best"]).minimise(problem, generator=rng.numpy_stream(0, "solver"))
    assert found.best.tolist() == [0, 1, 0, 1]


def test_other_constraints_are_no_groups():
    objective = Qubo.from_matrix(np.eye(6))
    for rows in (
        [],
        [exactly(1, [0, 1]), exactly(1, [1, 2])],
        [exactly(2, [0, 1, 2])],
        [exactly(1, [0, 1]), clause([3, 4])],
        [Linear({0: 1, 1: -1}, 1, 1)],
        [exactly(1, [0, 1]), exactly(1, [])],
    ):
        assert groups.groups_of(Constrained.of(objective, rows)) is None
    maxsat = WeightedMaxSat.from_clauses(2, [[1], [2]], [1.0, 2.0])
    assert groups.groups_of(Constrained.of(maxsat, [exactly(1, [0, 1])])) is None


def test_of_a_potts_model_one_turn_is_enough(monkeypatch):
    """Thirty sites of ten states: no higher than any descent, which the penalties of other constraints are."""
    draw = np.random.default_rng(0)
    coupling, linear = draw.normal(size=(60, 300)), draw.normal(size=360)
    objective = Qubo(Bipartite(300, 60), coupling, linear, np.zeros(()))
    problem = Constrained.of(objective, [exactly(1, range(10 * i, 10 * i + 10)) for i in range(30)])
    generator = rng.numpy_stream(0, "solver")
    drawn = groups.guides(objective, groups.groups_of(problem), generator)
    loop = PenaltyLoop(solver=GibbsAnnealing(n_restarts=16))
    found = loop.minimise(problem, generator=generator)
    assert found.energies.shape == (16,)
    assert found.best_energy <= problem.energy(drawn).min() + 1e-9
    monkeypatch.setattr(constrained, "groups_of", lambda problem: None)
    assert loop.minimise(problem, generator=generator).best_energy > 0.995 * found.best_energy


@pytest.mark.parametrize("solver", ["annealing", "tabu", "best", "clauses"])
def test_a_batch_of_objectives(solver):
    for seed in range(1, 9):
        problem = random_problem(seed, problems=(2, 3))
        broken, energies = ranks(problem)
        solution = PenaltyLoop(solver=SOLVERS[solver]).minimise(
            problem, generator=rng.numpy_stream(seed, "solver")
        )
        assert solution.best.shape == (2, 3, N)
        assert solution.broken.shape == solution.energies.shape
        if broken.min() == 0:
            lowest = np.where(broken == 0, energies, np.inf).min(-1)
            np.testing.assert_allclose(solution.best_energy, lowest)


def test_in_a_vertex_cover_a_penalty_is_the_weight_of_the_lighter_end():
    weights, edges = [5.0, 9.0, 7.0, 4.0], [(1, 2), (2, 3), (3, 4), (1, 4)]
    objective = WeightedMaxSat.from_clauses(4, [[-i] for i in range(1, 5)], weights)
    problem = Constrained.of(objective, [clause(edge) for edge in edges])
    assert local_penalties(problem).tolist() == [5.0, 7.0, 4.0, 4.0]


def test_breaking_a_constraint_never_pays_with_safe_penalties():
    n_feasible = 0
    for seed in range(24):
        problem = random_problem(seed)
        broken, energies = ranks(problem)
        if broken.min() == 0:
            penalised = problem.penalised(np.full(len(problem.constraints), safe_penalty(problem)))
            solution = BruteForce().minimise(as_qubo(penalised), generator=rng.numpy_stream(0, "solver"))
            lowest = float(solution.best_energy)
            assert lowest == pytest.approx(energies[broken == 0].min())
            n_feasible += 1
    assert n_feasible > 12


def test_gains_are_those_of_single_flips():
    for seed in range(24):
        problem = random_problem(seed)
        broken, energies = ranks(problem)
        if broken.min() > 0:
            continue
        states = binary_states(N, like=np.zeros(0))
        x = states[np.where(broken == 0, energies, np.inf).argmin()]
        expected = np.zeros(len(problem.constraints))
        for i in range(N):
            flipped = np.where(np.arange(N) == i, 1 - x, x)
            rows = problem.constraints
            breaks = rows.excess(rows.sums(flipped > 0.5)) > 0
            gain = float(problem.energy(x[None])[0] - problem.energy(flipped[None])[0])
            expected = np.maximum(expected, np.where(breaks, gain, 0))
        np.testing.assert_allclose(gains(problem, x), expected, atol=1e-9)


def test_penalties_rise_until_breaking_does_not_pay():
    """Each flip is cheap to undo alone, but the two constraints bar the way: the first penalties are too low."""
    clauses = [[i] for i in range(1, 7)]
    objective = WeightedMaxSat.from_clauses(7, clauses, [1.0] * 6)
    rows = [clause([-i, 7]) for i in range(1, 7)] + [clause([-7])]
    seen = []

    class Watched:
        def minimise(self, qubo, *, generator):
            seen.append(float(abs(qubo.linear).max()))
            return BruteForce().minimise(qubo, generator=generator)

    problem = Constrained.of(objective, rows)
    solution = PenaltyLoop(solver=Watched()).minimise(problem, generator=rng.numpy_stream(0, "solver"))
    assert len(seen) > 1
    assert sorted(seen) == seen
    assert float(solution.best_energy) == 6
    assert solution.status.tolist()[-1] == Status.OPTIMAL


def test_the_best_answer_breaks_the_fewest_whatever_its_energy():
    energies = np.array([[-9.0, 3.0, 2.0, -8.0], [0.0, 1.0, 2.0, -1.0]])
    assignments = np.broadcast_to(np.arange(4.0)[:, None], (2, 4, 1))
    broken = np.array([[2, 0, 0, 1], [3, 2, 2, 3]])
    solution = QuboSolution(assignments, energies, broken, broken, 0.0, broken=broken)
    assert solution.best_energy.tolist() == [2.0, 1.0]
    assert solution.best.tolist() == [[2.0], [1.0]]


def test_no_constraints_and_long_clauses():
    """Clauses of three literals and more have auxiliary variables, which are no part of the answer."""
    draw = random.Random(0)
    clauses = [[draw.choice([-1, 1]) * i for i in draw.sample(range(1, 8), k)] for k in [3, 4, 5, 6, 7] * 6]
    maxsat = WeightedMaxSat.from_clauses(N, clauses, [draw.randint(1, 9) for _ in clauses])
    lowest = maxsat.energy(binary_states(N, like=np.zeros(0))).min()
    for name in ("annealing", "tabu", "best", "bonds"):
        loop = PenaltyLoop(solver=SOLVERS[name])
        solution = loop.minimise(Constrained.of(maxsat, []), generator=rng.numpy_stream(0, "solver"))
        assert solution.assignments.shape[-1] == N
        assert float(solution.best_energy) == lowest


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"solver": 3}, "a solver, which has minimise"), ({"solver": BruteForce(), "n_turns": 0}, "n_turns = 0")],
)
def test_refusals(settings, message):
    with pytest.raises(SettingError, match=message):
        PenaltyLoop(**settings)


def test_it_ends_in_time_with_an_answer_that_keeps_the_constraints():
    generator = rng.numpy_stream(0, "dense")
    n = 200
    problem = Constrained.of(Qubo.from_matrix(generator.normal(size=(n, n))), [exactly(20, range(n))])
    begin = time.perf_counter()
    found = Search(time_limit=0.3).run(problem, Portfolio())
    assert time.perf_counter() - begin < 20  # a hundred times as long without the limit
    assert found.states[0].n_broken == 0


def test_rows_that_no_state_breaks_cost_nothing():
    free = Constrained.of(Qubo.from_matrix(np.eye(20)), [Linear(dict.fromkeys(range(20), 1), 0, 20)])
    given = free.penalised(np.ones(1))
    assert (given.n, len(given.graph.edges())) == (20, 0)


def test_a_proof_that_nothing_is_feasible_is_not_lost():
    none = Constrained.of(
        Qubo.from_matrix(np.zeros((3, 3))), [exactly(3, range(3)), *(exactly(0, [i]) for i in range(3))]
    )
    assert Search().run(none, BruteForce()).conclusion is Status.INFEASIBLE
