"""Answers of every solver in the terms of the file, against enumeration in Python's fractions."""

import itertools
import json
import random
from fractions import Fraction

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.problems import Qubo, read_problem, to_qubo
from memcomp_lightning.solvers import (
    AlternatingDescent,
    Answer,
    BruteForce,
    CrossoverAnnealing,
    GibbsAnnealing,
    Portfolio,
    Search,
    Status,
    TabuSearch,
    write_solution,
)
from memcomp_lightning.solvers.dmm import BondField, DmmSolver

SOLVERS = {
    "brute force": BruteForce(),
    "descent": AlternatingDescent(n_restarts=12),
    "annealing": GibbsAnnealing(n_restarts=12, n_sweeps=30),
    "tabu": TabuSearch(n_restarts=12, n_steps=50),
    "crossover": CrossoverAnnealing(n_restarts=12, n_sweeps=10, n_rounds=3),
    "best": Portfolio(n_restarts=12),
    "clauses": DmmSolver(n_restarts=12),
    "bonds": DmmSolver(field=BondField(), n_restarts=12),
    "reference": DmmSolver(n_restarts=12, max_steps=15, kernel="reference"),
}


def seeds(name):
    """The plain kernel takes many times as long as the others."""
    return range(9 if name == "reference" else 36)


# Small numbers, numbers that float64 rounds when they are added up, and decimal fractions, which it always rounds.
SIZES = [
    ["1", "2", "3"],
    ["1073741824", "3", "1"],
    ["18014398509481984", "3", "5"],
    ["9007199254740993", "1", "9007199254740992"],
    ["0.1", "0.2", "0.3", "0.7"],
    ["1e15", "0.001", "7"],
    ["1e-9", "2e-9", "1"],
    ["4611686018427387904", "1"],
    ["1e30", "1"],
]


def answer_of(name, problem, seed):
    """What a solver finds, as ``memcomp-solve`` asks it."""
    return Answer.of(problem, Search().run(problem, SOLVERS[name], seed=seed))


def random_formula(seed):
    """Clauses of up to three literals, some hard: lines and what they mean."""
    draw = random.Random(seed)
    n, sizes, longest = draw.randint(1, 4), SIZES[seed % len(SIZES)], draw.choice([1, 2, 2, 3])
    clauses = []
    for _ in range(draw.randint(1, 10)):
        length = draw.randint(0 if draw.random() < 0.1 else 1, longest)
        literals = [draw.choice([-1, 1]) * draw.randint(1, n) for _ in range(length)]
        clauses.append(("h" if draw.random() < 0.3 else draw.choice(sizes), literals))
    return clauses


def cost(clauses, x):
    """Unsatisfied hard clauses, weight of unsatisfied soft ones."""
    false = [weight for weight, clause in clauses if not any(x[abs(q) - 1] == (q > 0) for q in clause)]
    return false.count("h"), sum((Fraction(weight) for weight in false if weight != "h"), Fraction(0))


@pytest.mark.parametrize("name", SOLVERS)
def test_clauses(tmp_path, name):
    n_proven = 0
    for seed in seeds(name):
        clauses = random_formula(seed)
        lines = "".join(f"{weight} {' '.join(map(str, clause))} 0\n" for weight, clause in clauses)
        (tmp_path / "a.wcnf").write_text(lines)
        problem = read_problem(tmp_path / "a.wcnf")
        answer = answer_of(name, problem, seed)
        lowest = min(cost(clauses, x) for x in itertools.product((0, 1), repeat=problem.n))
        found = cost(clauses, answer.assignment.astype(int).tolist())
        assert (answer.score.hard_unsatisfied, answer.score.value) == found, lines
        assert found[0] == lowest[0], f"feasibility ranks before cost:\n{lines}"
        assert answer.energy == min(energy for energy in answer.energies if energy is not None)
        if answer.optimal:
            assert found == lowest, lines
            assert found[0] == 0
        assert (Status.INFEASIBLE in answer.status) <= (lowest[0] > 0)
        n_proven += answer.optimal or Status.INFEASIBLE in answer.status
    assert n_proven > 20 or name != "brute force"


def random_sum(seed):
    """Entries ``i j number`` and a constant."""
    draw = random.Random(seed)
    n, sizes = draw.randint(1, 4), SIZES[seed % len(SIZES)]
    entries = [
        (draw.randrange(n), draw.randrange(n), draw.choice(["", "-"]) + draw.choice(sizes))
        for _ in range(draw.randint(1, 8))
    ]
    return n, entries, draw.choice(["0", draw.choice(sizes)])


def text_of(kind, n, entries, constant):
    rows = "".join(f"{i} {j} {number}\n" for i, j, number in entries)
    if kind == "cut":
        return f"{n} {len(entries)}\n" + "".join(f"{i + 1} {j + 1} {number}\n" for i, j, number in entries)
    return f"# vartype={kind} offset={constant}\n{rows}"


def value(kind, entries, constant, x):
    if kind == "cut":
        return sum((Fraction(number) for i, j, number in entries if x[i] != x[j]), Fraction(0))
    s = [2 * bit - 1 for bit in x] if kind == "SPIN" else x
    return Fraction(constant) + sum(
        Fraction(number) * (s[i] if i == j else s[i] * s[j]) for i, j, number in entries
    )


@pytest.mark.parametrize("kind", ["cut", "SPIN", "BINARY"])
@pytest.mark.parametrize("name", SOLVERS)
def test_sums(tmp_path, name, kind):
    n_proven = 0
    for seed in seeds(name):
        n, entries, constant = random_sum(seed)
        maximise = kind != "cut" and seed % 2 == 1
        (tmp_path / "a.txt").write_text(text_of(kind, n, entries, constant))
        problem = read_problem(tmp_path / "a.txt", "gset" if kind == "cut" else "coo", maximise=maximise)
        answer = answer_of(name, problem, seed)
        sign = -1 if problem.objective.maximised else 1
        lowest = min(sign * value(kind, entries, constant, x) for x in itertools.product((0, 1), repeat=problem.n))
        found = value(kind, entries, constant, answer.assignment.astype(int).tolist())
        assert answer.score == (found, 0)
        assert answer.energy == sign * found
        if answer.optimal:
            assert answer.energy == lowest, (tmp_path / "a.txt").read_text()
            n_proven += 1
    assert n_proven > 15 or name != "brute force"


# ------------------------------------------------------------------------------------------------ single cases


@pytest.mark.parametrize("name", SOLVERS)
def test_a_hard_clause_holds_against_weights_beyond_2_to_the_53(tmp_path, name):
    """Added up as floats the hundred small ones weigh 400, and the hard clause no more than all of them."""
    (tmp_path / "a.wcnf").write_text(f"{2**54} 1 0\nh -1 0\n" + "3 1 0\n" * 100)
    problem = read_problem(tmp_path / "a.wcnf")
    answer = answer_of(name, problem, 0)
    assert answer.assignment.tolist() == [False]
    assert answer.score == (2**54 + 300, 0)
    assert answer.optimal == (name == "brute force")
    assert any("2^53" in remark for remark in problem.remarks)


def test_the_best_restart_is_feasible_whatever_its_cost(tmp_path):
    (tmp_path / "a.wcnf").write_text(f"h -1 -2 0\n{2**60} 1 0\n{2**60} 2 0\n1 -1 0\n")
    problem = read_problem(tmp_path / "a.wcnf")
    states = torch.tensor([[1, 1], [1, 0], [0, 1], [0, 0]])
    solution = BruteForce().minimise(to_qubo(problem.problem), generator=rng.stream(0, "solver"))
    four = type(solution)(
        states.double(), torch.zeros(4), torch.full((4,), int(Status.STEP_BUDGET)), states[:, 0], 0.0
    )
    answer = Answer.of(problem, four)
    assert answer.assignment.tolist() == [False, True]
    assert answer.score == (2**60, 0)
    assert (answer.n_run, answer.n_reached) == (4, 1)


def test_unsatisfiable_hard_clauses_are_never_called_optimal(tmp_path):
    (tmp_path / "a.wcnf").write_text("h 1 0\nh -1 0\nh 1 2 0\n5 -2 0\n")
    problem = read_problem(tmp_path / "a.wcnf")
    answer = answer_of("brute force", problem, 0)
    assert answer.status == [Status.INFEASIBLE]
    assert answer.score == (0, 1)
    assert not answer.optimal


def test_float_arithmetic_that_cannot_prove_says_so(tmp_path):
    (tmp_path / "a.txt").write_text(f"3 3\n1 2 {2**53 + 1}\n2 3 1\n1 3 -{2**53 + 1}\n")
    problem = read_problem(tmp_path / "a.txt")
    exact, rounded = (
        BruteForce().minimise(given, generator=rng.stream(0, "solver"))
        for given in (problem.integers, problem.problem)
    )
    assert exact.status.tolist() == [Status.OPTIMAL]
    assert rounded.status.tolist() == [Status.ROUNDED]
    assert Answer.of(problem, exact).score.value == 2**53 + 2
    claimed = type(rounded)(rounded.assignments, rounded.energies, exact.status, rounded.steps, 0.0)
    assert Answer.of(problem, claimed).status == [Status.ROUNDED], "float64 proves nothing here, whoever says so"


def test_energies_a_rounding_apart_are_not_the_same(tmp_path):
    (tmp_path / "a.coo").write_text(f"0 0 -{10**12}\n1 1 -1\n")
    problem = read_problem(tmp_path / "a.coo")
    solution = AlternatingDescent(n_restarts=2).minimise(problem.problem, generator=rng.stream(0, "solver"))
    two = type(solution)(
        torch.tensor([[1.0, 1.0], [1.0, 0.0]]), solution.energies, solution.status, solution.steps, 0.0
    )
    assert Answer.of(problem, two).n_reached == 1


def test_numbers_in_json_are_whole(tmp_path):
    (tmp_path / "a.wcnf").write_text(f"h -1 0\n{2**62 + 1} 1 0\n")
    (tmp_path / "b.coo").write_text("0 0 -0.12345678901234567891\n")
    written = []
    for name in ("a.wcnf", "b.coo"):
        problem = read_problem(tmp_path / name)
        given = problem.problem if isinstance(problem.problem, Qubo) else to_qubo(problem.problem)
        solution = BruteForce().minimise(given, generator=rng.stream(0, "solver"))
        write_solution(tmp_path / "s.json", problem, solution, solver={}, seed=0)
        written.append(json.loads((tmp_path / "s.json").read_text(), parse_constant=pytest.fail))
    assert written[0]["objective"]["value"] == written[0]["energy"] == 2**62 + 1
    assert written[0]["restarts"]["energy"] == [2**62 + 1]
    assert written[1]["objective"]["value"] == pytest.approx(-0.12345678901234568)
    assert written[1]["objective"]["value_in_full"] == "-0.12345678901234567891"
    assert "remarks" in written[0]["problem"]
