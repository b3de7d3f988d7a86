"""``memcomp_lightning.solve`` for every kind of input, against enumeration in the input's own terms."""

import itertools
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch

from memcomp_lightning import rng, solve
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.problems import (
    Constrained,
    Linear,
    ProblemFileError,
    Qubo,
    WeightedMaxSat,
    exactly,
    read_problem,
)
from memcomp_lightning.solvers import AlternatingDescent, Portfolio, Status, TabuSearch
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.testing import small_rbm

N = 13  # more than a Portfolio enumerates
LABELS = [*"abcdefg", *range(4), ("x", 1), None]
NUMBERS = rng.numpy_stream(0, "numbers").normal(size=(N, N))
CLAUSES = [[1, 2, 3], [-1, -2], [2, -3, 4], [-4, 5], [-5], [1, -6, 7], [-7, 6, -1]]


def quadratic(matrix):
    return lambda x: np.einsum("...i,ij,...j", x, matrix, x)


def ising(h, pairs):
    return lambda s: s @ h + np.einsum("...i,ij,...j", s, pairs, s)


PAIRS = np.triu(NUMBERS, 1)
FIELDS = NUMBERS.diagonal()
BOTH_WAYS = NUMBERS - np.diag(FIELDS)


def by_label(matrix):
    return {(LABELS[i], LABELS[j]): matrix[i, j] for i, j in np.argwhere(matrix)}


def of_networkx(kind="Graph"):
    networkx = pytest.importorskip("networkx")
    graph = getattr(networkx, kind)()
    graph.add_nodes_from(LABELS[:-1])  # None is no node
    for i, j in np.argwhere(PAIRS[: N - 1, : N - 1]):
        weight = {} if i == 0 else {"weight": PAIRS[i, j]}
        graph.add_edge(LABELS[i], LABELS[j], **weight)
        if kind == "MultiGraph" and i < 3:
            graph.add_edge(LABELS[j], LABELS[i], weight=-0.5)
    weights = networkx.to_numpy_array(graph)
    return graph, lambda x: -(x @ weights * (1 - x)).sum(-1), LABELS[:-1]


def of_dimod(vartype):
    dimod = pytest.importorskip("dimod")
    model = dimod.BinaryQuadraticModel(
        dict(zip(LABELS[:-1], FIELDS, strict=False)), by_label(PAIRS[:-1, :-1]), 1.5, vartype
    )
    pairs, h = PAIRS[:-1, :-1], FIELDS[:-1]
    return model, lambda x: 1.5 + ising(h, pairs)(x), LABELS[:-1]


def of_cqm():
    """Every other variable is a spin; no more than two of the bits are 1."""
    dimod = pytest.importorskip("dimod")
    kinds = [dimod.Spin if k % 2 == 0 else dimod.Binary for k in range(N)]
    variables = [kind(f"v{k}") for k, kind in enumerate(kinds)]
    cqm = dimod.ConstrainedQuadraticModel()
    cqm.set_objective(sum(PAIRS[i, j] * variables[i] * variables[j] for i, j in np.argwhere(PAIRS)))
    cqm.add_constraint(sum(variables[1::2]) <= 2)

    labels = list(cqm.variables)
    order = [labels.index(f"v{k}") for k in range(N)]

    def energy(values):
        x = values[..., order]
        return np.where(x[..., 1::2].sum(-1) > 2, np.inf, np.einsum("...i,ij,...j", x, PAIRS, x))

    return cqm, energy, labels


def of_rbm():
    rbm = small_rbm(8, 5).double()
    return rbm, lambda x: rbm.energy(*torch.tensor(np.atleast_2d(x)).split([8, 5], dim=-1)).detach().numpy(), None


def of_file():
    Path("spins.coo").write_text(
        "# vartype=SPIN\n" + "".join(f"{i} {j} {NUMBERS[i, j]:.3f}\n" for i in range(N) for j in range(i + 1))
    )
    matrix = np.tril(NUMBERS).round(3)
    own = matrix.diagonal().copy()
    np.fill_diagonal(matrix, 0)
    return "spins.coo", ising(own, matrix), None


def of_clauses():
    def energy(x):
        true = [(x[..., [abs(k) - 1 for k in c]] > 0.5) == (np.array(c) > 0) for c in CLAUSES]
        return sum((k + 1) * ~clause.any(-1) for k, clause in enumerate(true)).astype(float)

    return WeightedMaxSat.from_clauses(7, CLAUSES, range(1, 8)), energy, None


SPARSE = PAIRS * (abs(PAIRS) > 1)
KINDS = {
    "array": lambda: (NUMBERS, quadratic(NUMBERS), None),
    "integers": lambda: (np.rint(3 * NUMBERS).astype(np.int32), quadratic(np.rint(3 * NUMBERS)), None),
    "scipy": lambda: (sp.csr_array(SPARSE + np.diag(FIELDS)), quadratic(SPARSE + np.diag(FIELDS)), None),
    "old scipy": lambda: (sp.lil_matrix(NUMBERS), quadratic(NUMBERS), None),
    "tensor": lambda: (torch.tensor(NUMBERS, requires_grad=True), quadratic(NUMBERS), None),
    "sparse tensor": lambda: (torch.tensor(NUMBERS).to_sparse(), quadratic(NUMBERS), None),
    "dict": lambda: (by_label(NUMBERS), quadratic(NUMBERS), LABELS),
    "spins by label": lambda: (
        (dict(zip(LABELS, FIELDS, strict=True)), by_label(PAIRS)),
        ising(FIELDS, PAIRS),
        LABELS,
    ),
    "spins and a matrix": lambda: (
        (FIELDS, NUMBERS - np.diag(FIELDS)),
        ising(FIELDS, NUMBERS - np.diag(FIELDS)),
        None,
    ),
    "spins and a sparse matrix": lambda: ((list(FIELDS), sp.coo_array(PAIRS)), ising(FIELDS, PAIRS), None),
    "spins and pairs": lambda: (
        (FIELDS, {(i, j): PAIRS[i, j] for i in range(N) for j in range(i + 1, N)}),
        ising(FIELDS, PAIRS),
        None,
    ),
    "graph": of_networkx,
    "multigraph": lambda: of_networkx("MultiGraph"),
    "BQM of bits": lambda: of_dimod("BINARY"),
    "BQM of spins": lambda: of_dimod("SPIN"),
    "CQM": of_cqm,
    "RBM": of_rbm,
    "file": of_file,
    "read file": lambda: (read_problem(of_file()[0]), *of_file()[1:]),
    "Qubo": lambda: (Qubo.from_matrix(NUMBERS), quadratic(NUMBERS), None),
    "clauses": of_clauses,
}
OF_SPINS = ("spins by label", "spins and a matrix", "spins and a sparse matrix", "spins and pairs", "BQM of spins")
OF_SPINS += ("file", "read file")


@pytest.mark.parametrize("kind", KINDS)
def test_the_minimum_in_the_inputs_own_terms(kind, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    given, energy, labels = KINDS[kind]()
    solver = "dmm" if kind == "clauses" else "best"
    found = solve(given, solver=solver, seed=3, n_solutions=3)
    low = np.array([-(int(v[1:]) % 2 == 0) for v in labels]) if kind == "CQM" else -1 if kind in OF_SPINS else 0
    n = 7 if kind == "clauses" else N if labels is None else len(labels)
    states = np.array(list(itertools.product([0, 1], repeat=n)), np.float64)
    states = np.where(states == 0, low, 1.0)
    for state in found.solutions:
        if labels is None:
            assert state.values.shape == (n,)
            values = state.values
        else:
            assert list(state.values) == labels
            values = np.array(list(state.values.values()))
        assert ((values == low) | (values == 1)).all()
        assert energy(values.astype(np.float64)) == pytest.approx(float(state.energy), abs=1e-6)
    assert float(found.best_energy) == pytest.approx(energy(states).min(), abs=1e-6)
    assert found.solutions[0].energy == found.best_energy
    assert found.lower_bound <= found.best_energy + 1e-9
    assert (found.answer is not None) == (kind in ("file", "read file"))
    again = solve(
        given, solver=solver, seed=3, initial=[state.values for state in reversed(found.solutions)], target=1e9
    )
    assert again.best_energy == pytest.approx(found.best_energy), "what came out goes in again"


def test_a_file_is_answered_exactly(tmp_path):
    (tmp_path / "G.txt").write_text("4 4\n1 2 3\n2 3 4\n3 4 5\n4 1 6\n")
    found = solve(tmp_path / "G.txt", target=18)
    assert (found.best_energy, found.answer.score.value, found.status) == (-18, 18, Status.OPTIMAL)
    assert isinstance(found.best_energy, int)


@pytest.mark.parametrize("form", ["graph", "file"])
def test_a_target_is_in_the_terms_of_what_is_maximised(form, tmp_path):
    """The first state met cuts something, and would do for a target of minus one."""
    draw = rng.numpy_stream(0, "graph")
    edges = [(i, j) for i in range(30) for j in range(i) if draw.random() < 0.5]
    (tmp_path / "G.txt").write_text(f"30 {len(edges)}\n" + "".join(f"{i + 1} {j + 1} 1\n" for i, j in edges))
    given = tmp_path / "G.txt"
    if form == "graph":
        given = pytest.importorskip("networkx").Graph(edges)
    best = -solve(given, seed=5).best_energy
    found = solve(given, seed=1, solver=AlternatingDescent(n_restarts=1), target=best)
    assert found.best_energy == -best
    assert found.curve[0][1] <= 0


def test_callbacks_come_in_falling_order_with_the_states():
    draw = rng.numpy_stream(1, "numbers").normal(size=(60, 60))
    told = []
    found = solve(
        draw - np.diag(draw.sum(0)), solver=AlternatingDescent(n_restarts=1), time_limit=0.2, callback=told.append
    )
    assert [(state.seconds, state.energy) for state in told] == found.curve
    energies = [state.energy for state in told]
    assert energies == sorted(set(energies), reverse=True)
    assert energies[-1] == found.best_energy
    assert np.array_equal(told[-1].values, found.best)


def test_same_seed_same_answer_as_the_solver_alone():
    draw = rng.numpy_stream(1, "numbers").normal(size=(60, 60))
    solver = TabuSearch(n_steps=30, n_restarts=5)
    found, again, other = (solve(draw, solver=solver, seed=seed) for seed in (0, 0, 1))
    alone = solver.minimise(Qubo.from_matrix(draw), generator=rng.numpy_stream(0, "solver"))
    assert found.energies.tolist() == again.energies.tolist() == alone.energies.tolist() != other.energies.tolist()
    assert np.array_equal(found.best, again.best)
    assert found.n_reached == again.n_reached >= 1


def test_restarts_that_were_not_run_have_no_energy():
    found = solve(NUMBERS, solver=DmmSolver(n_restarts=28, patience=4))
    assert 0 < np.isnan(found.energies).sum() < 28
    assert found.best_energy == np.nanmin(found.energies)


def test_what_was_found_in_a_line():
    found = solve({("a", "b"): -2.0, ("b", "c"): 3.0})
    assert repr(found).startswith("<Solution: energy -2.0 OPTIMAL, reached by 1 of 1 restarts, ")
    assert found.best == {"a": 1, "b": 1, "c": 0}


REFUSED = {
    "a list": ([[1, 2], [3, 4]], "problem = 'list' is not allowed: expected a square matrix"),
    "matrices": ([NUMBERS, NUMBERS], "problem = 'list'"),
    "a number": (3, "problem = 'int'"),
    "rows": (NUMBERS[:3], "shape of the problem = (3, 13) is not allowed: expected (n, n)"),
    "a stack": (np.zeros((2, 3, 3)), "(2, 3, 3)"),
    "nothing": (np.zeros((0, 0)), "(0, 0)"),
    "complex": (NUMBERS * 1j, "type of the problem's numbers = 'complex128'"),
    "objects": (NUMBERS.astype(object), "'object'"),
    "infinite": (np.diag([1, math.inf]), "NaN or infinite"),
    "keys": ({"a": 1}, "key = 'a' is not allowed: expected a pair of variables (i, j)"),
    "values": ({("a", "b"): "1 cm"}, "The problem's numbers are not all real numbers"),
    "an empty dict": ({}, "number of variables = 0"),
    "three parts": ((1, 2, 3), "problem = 'tuple'"),
    "a coupling of one": (
        ({"a": 1}, {("a", "a"): 1}),
        "J's entry = ('a', 'a') is not allowed: expected pairs of two",
    ),
    "an index": (
        ([1.0, 2.0], {(0, 2): 1.0}),
        "J's index = 2 is not allowed: expected integers from 0 to n - 1 = 1",
    ),
    "h": ((NUMBERS, PAIRS), "shape of h = (13, 13)"),
    "J": ((FIELDS, FIELDS), "shape of J = (13,)"),
    "several": (Qubo.from_matrix(np.ones((2, 3, 3))), "problems = (2,)"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_other_inputs_are_refused_in_a_line(case):
    given, message = REFUSED[case]
    with pytest.raises(SettingError) as error:
        solve(given)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_more_that_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ProblemFileError, match="there is no such file"):
        solve(tmp_path / "none.txt")
    with pytest.raises(SettingError, match="solver = 'simplex' is not allowed: expected one of 'best'"):
        solve(NUMBERS, solver="simplex")
    with pytest.raises(SettingError, match=r"solver = 'Portfolio' .* Make one: Portfolio\(...\)"):
        solve(NUMBERS, solver=Portfolio)
    monkeypatch.setattr("memcomp_lightning.solvers.solving._installed", lambda: 1000.0)
    with pytest.raises(UserError, match=r"13 variables, 78 couplings. Portfolio with .* more than there is"):
        solve(NUMBERS)


def test_directed_graphs_are_refused():
    with pytest.raises(SettingError, match="a directed graph"):
        solve(pytest.importorskip("networkx").DiGraph([(1, 2)]))


@pytest.mark.parametrize(
    ("given", "initial", "message"),
    [
        (NUMBERS, np.zeros(12), r"shape of initial = \(1, 12\) is not allowed: expected \(13,\) or"),
        (NUMBERS, np.full(13, -1), r"values in {0, 1}"),
        ((FIELDS, PAIRS), np.zeros(13), r"values in {-1, 1}"),
        ({("a", "b"): 1}, {"a": 1}, "a value for each of the 2 variables"),
        ({("a", "b"): 1}, [[0, 1]], "a value for each of the 2 variables"),
        ({("a", "b"): 1}, {"a": 1, "b": 2}, r"values in {0, 1}"),
    ],
)
def test_initial_states_that_are_none(given, initial, message):
    with pytest.raises(SettingError, match=message):
        solve(given, initial=initial)


def test_no_torch_without_tensors():
    program = (
        "import sys, numpy as np; from memcomp_lightning import solve\n"
        "solve({('a', 'b'): 1.0}); solve(np.ones((15, 15)) - 9 * np.eye(15), n_solutions=2)\n"
        "assert not {'torch', 'lightning', 'hydra'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize(
    ("given", "settings", "match"),
    [
        (np.eye(2), {"seed": "x"}, "seed = 'x'"),
        (np.eye(2), {"seed": 1.5}, "seed = 1.5"),
        (np.eye(2), {"callback": 3}, "callback = 3"),
    ],
)
def test_settings_of_another_kind_are_refused(given, settings, match):
    with pytest.raises(SettingError, match=match):
        solve(given, **settings)


@pytest.mark.filterwarnings("ignore::PendingDeprecationWarning")
def test_matrices_of_every_class_are_taken():
    scipy_sparse = pytest.importorskip("scipy.sparse")
    matrix = np.array([[-1.0, 2.0], [0.0, -3.0]])
    for kind in (np.asmatrix, scipy_sparse.dok_array, scipy_sparse.lil_matrix, scipy_sparse.dia_array):
        assert solve(kind(matrix)).best_energy == -3.0


@pytest.mark.parametrize("solver", ["brute_force", "best"])
def test_numbers_too_far_apart_for_float64_are_no_proof(solver):
    assert solve(np.diag([-1e15, -0.01]), solver=solver).status is Status.ROUNDED


def test_what_breaks_a_constraint_is_not_feasible_whatever_else_is_asked():
    rows = [Linear({1: -3}, -1, -1), Linear({0: 1, 1: 1}, 1, None)]
    none = Constrained.of(Qubo.from_matrix(np.diag([-4.0, -3.0])), rows)
    for n_solutions in (1, 2):
        assert solve(none, solver="tabu", n_solutions=n_solutions).status is Status.NOT_FEASIBLE


def test_constraints_that_memory_cannot_hold_are_refused_before_they_are_written():
    n = 200_000
    nothing = Qubo.from_coo(n, np.arange(n), np.arange(n), np.ones(n))
    with pytest.raises(UserError, match="Constraints of up to 200000 variables couple 19999900000 pairs"):
        solve(Constrained.of(nothing, [exactly(1, range(n))]))


def test_constraints_of_another_kind_are_refused():
    with pytest.raises(SettingError, match="objective = 'ndarray'"):
        Constrained.of(np.eye(2), [])
    with pytest.raises(SettingError, match="constraint = 'x0"):
        Constrained.of(Qubo.from_matrix(np.eye(2)), ["x0 == 1"])


@pytest.mark.parametrize("solver", ["best", "annealing", "tabu", "dmm", "brute_force"])
@pytest.mark.parametrize("write", [np.array, torch.tensor, sp.csr_array, "pairs"])
def test_whole_numbers_beyond_those_of_float64_are_added_up_as_integers(write, solver):
    """Found by tests/campaigns/random_problems.py: energies were rounded, and lower bounds lay above them."""
    rows = [[2**55 + 1, -3, 0], [0, -(2**54) - 7, 2], [0, 0, -1]]
    entries = {(i, j): q for i, row in enumerate(rows) for j, q in enumerate(row)}
    found = solve(entries if write == "pairs" else write(rows), solver=solver)
    assert (type(found.best_energy), found.best_energy) == (int, -(2**54) - 7)
    assert found.solutions[0].energy == found.best_energy
    assert found.lower_bound <= found.best_energy


def test_spins_and_cuts_of_large_whole_numbers_are_exact_where_int64_holds_them():
    large = 2**56 + 1
    found = solve(({"a": 0, "b": 1}, {("a", "b"): large}), solver="brute_force")
    assert found.best_energy == -large - 1
    graph = pytest.importorskip("networkx").Graph()
    graph.add_edge("a", "b", weight=large)
    assert solve(graph, solver="brute_force").best_energy == -large
    # Of numbers that int64 does not hold, energies are rounded as those of real numbers are.
    assert solve({("a", "a"): -(2**70) - 1}).best_energy == -(2.0**70)
