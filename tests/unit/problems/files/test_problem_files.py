"""Problem files: energies against the formats' own definitions, faults with their place."""

import bz2
import gzip
import io
import itertools
import json
import lzma
import math
import os
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import mmread

from memcomp_lightning import __version__, rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import RBM
from memcomp_lightning.problems import (
    FORMATS,
    ProblemFileError,
    Qubo,
    WeightedMaxSat,
    is_problem_file,
    read_problem,
)
from memcomp_lightning.solvers import Answer, BruteForce, QuboSolution, Status, write_solution

DATA = Path(os.environ.get("MEMCOMP_DATA_DIR", "")) / "qubo"
needs_qubo_files = pytest.mark.skipif(
    not (os.environ.get("MEMCOMP_DATA_DIR") and DATA.is_dir()), reason="MEMCOMP_DATA_DIR has no folder qubo"
)


@pytest.fixture
def write(tmp_path):
    """Write a file, text or bytes."""

    def write_file(name, content):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write_file


def states(n):
    return torch.tensor(list(itertools.product((0, 1), repeat=n)), dtype=torch.float64)


def check(problem, energy, objective):
    """Compare with plain Python functions of one state, a list of 0 and 1, on all states."""
    for x, found in zip(states(problem.problem.n), problem.problem.energy(states(problem.problem.n)), strict=True):
        assert float(found) == pytest.approx(energy(x.tolist()), abs=1e-12)
        assert problem.score(x).value == pytest.approx(objective(x.tolist()), abs=1e-12)


# ------------------------------------------------------------------------------------------------ MAX-CUT

EDGES = [(1, 2, 3), (2, 3, -1), (1, 4, 2.5), (3, 4, 1), (1, 2, 1)]


def cut(x, edges=EDGES):
    return sum(w for i, j, w in edges if x[i - 1] != x[j - 1])


@pytest.mark.parametrize("header", ["4 5", "4 5 J", "  4\t5   planar, seed 3 "])
@pytest.mark.parametrize("name", ["G.txt", "G", "G.mc", "bench-1.0"])
def test_gset(write, name, header):
    lines = [header, *(f"{i} {j} {w}" for i, j, w in EDGES)]
    problem = read_problem(write(name, "\n".join(lines)))
    check(problem, lambda x: -cut(x), cut)
    assert problem.format == "gset"
    assert (problem.objective.name, problem.objective.direction) == ("cut weight", "maximise")
    assert problem.sizes == {"variables": 4, "couplings": 4}, "entries of a pair add up"


def test_gset_without_weights_windows_lines_and_blank_lines(write):
    problem = read_problem(write("G.txt", "\r\n3 2\r\n\r\n1 2\r\n3 1\r\n\r\n"))
    check(problem, lambda x: -cut(x, [(1, 2, 1), (3, 1, 1)]), lambda x: cut(x, [(1, 2, 1), (3, 1, 1)]))


def test_gset_without_edges(write):
    problem = read_problem(write("G.txt", "3 0\n"))
    assert problem.sizes == {"variables": 3, "couplings": 0}
    assert problem.score(torch.zeros(3)).value == 0
    assert problem.problem.n == 0, "unused variables are no part of the problem"


def test_gset_is_maximised_with_or_without_the_option(write):
    path = write("G.txt", "2 1\n1 2 7\n")
    for maximise in (True, False):
        assert read_problem(path, maximise=maximise).problem.energy(torch.tensor([[0.0, 1.0]])).item() == -7


# ------------------------------------------------------------------------------------------------ x'Qx

ENTRIES = {(1, 1): -3.0, (1, 3): 2.0, (2, 3): -5.0, (3, 3): 4.0}


def quadratic(x):
    """x'Qx with the full symmetric matrix."""
    matrix = np.zeros((3, 3))
    for (i, j), q in ENTRIES.items():
        matrix[i - 1, j - 1] = matrix[j - 1, i - 1] = q
    return float(np.array(x) @ matrix @ np.array(x))


@pytest.mark.parametrize("maximise", [False, True])
def test_beasley(write, maximise):
    lines = ["3 4", *(f" {i} {j} {q:g} " for (i, j), q in ENTRIES.items())]
    problem = read_problem(write("b.sparse", "\n".join(lines)), maximise=maximise)
    sign = -1 if maximise else 1
    check(problem, lambda x: sign * quadratic(x), quadratic)
    assert problem.objective.direction == ("maximise" if maximise else "minimise")


# ------------------------------------------------------------------------------------------------ dimod's list

BIASES = [(0, 0, 0.5), (0, 2, -1.25), (2, 1, 3.0), (1, 1, 1e-3), (0, 2, 0.5)]
COO = "\n".join(f"{i} {j} {bias}" for i, j, bias in BIASES)


def biased(x):
    return sum(bias * (x[i] if i == j else x[i] * x[j]) for i, j, bias in BIASES)


@pytest.mark.parametrize("maximise", [False, True])
@pytest.mark.parametrize(
    "vartype", ["", "# vartype=BINARY\n", "# vartype=SPIN\n", "#  my model, vartype: SPIN\n\n# z\n"]
)
@pytest.mark.parametrize("name", ["m.coo", "m.txt", "m"])
def test_coo(write, name, vartype, maximise):
    problem = read_problem(write(name, f"{vartype}{COO} # the last\n"), maximise=maximise)
    spin = "SPIN" in vartype

    def objective(x):
        return biased([2 * bit - 1 for bit in x] if spin else x)

    check(problem, lambda x: -objective(x) if maximise else objective(x), objective)
    assert problem.objective.name == ("SPIN energy" if spin else "BINARY energy")


@pytest.mark.parametrize(
    "spelling",
    [
        "# vartype = SPIN", "# vartype='SPIN'", '# {"vartype": "SPIN"}', "#vartype:spin",
        "# Vartype.SPIN, vartype is Spin",
        "# vartype=Vartype.SPIN", "# VARTYPE SPIN", "# a spin glass\n# vartype=SPIN\n# vartype=spin",
    ],
)  # fmt: skip
def test_spellings_of_the_vartype(write, spelling):
    problem = read_problem(write("a.coo", f"{spelling}\n0 0 1\n0 1 -2\n"))
    check(problem, *[lambda x: (2 * x[0] - 1) - 2 * (2 * x[0] - 1) * (2 * x[1] - 1)] * 2)


@pytest.mark.parametrize("offset", ["# offset=42", '# {"offset": 42}', "# Offset : '42'", "# constant = 4.2e1"])
@pytest.mark.parametrize("vartype", ["SPIN", "BINARY"])
def test_an_offset_is_counted_and_said(write, offset, vartype):
    path = write("a.coo", f"# vartype={vartype}\n{offset}\n0 1 -2\n")
    problem, plain = read_problem(path), read_problem(write("b.coo", f"# vartype={vartype}\n0 1 -2\n"))
    for x in states(2):
        assert problem.score(x).value == plain.score(x).value + 42
    assert np.array_equal(problem.problem.energy(states(2)), plain.problem.energy(states(2)) + 42)
    assert "is counted" in problem.remarks[0]


def test_what_is_not_read_is_named(write):
    remarks = {
        "a.coo": ("# vartype=SPIN, n=2\n0 1 1\n", "Line 1: 'n=2' stands in a comment and is not read."),
        "a.mc": ("3 1 J\n1 2 1\n", "Line 1: 'J' after the two numbers is not read."),
        "a.cnf": ("c offset=3\np cnf 1 1\n1 0\n", "Line 1: 'offset=3' stands in a comment and is not read."),
        "a.sparse": ("2 1\n1 2 1\n# scale: 2\n", "Line 3: 'scale: 2' stands in a comment and is not read."),
    }
    for name, (text, remark) in remarks.items():
        assert read_problem(write(name, text)).remarks == (remark,)


@pytest.mark.parametrize("text", ["4 3 1\n1 2 5\n2 3 5\n3 4 5\n"])
def test_three_numbers_are_a_header_or_an_entry_as_the_option_says(write, text):
    path = write("a.txt", text)
    assert read_problem(path, "gset").score(torch.tensor([1, 0, 1, 0])).value == 15
    assert read_problem(path, "coo").score(torch.ones(5)).value == 16


# ---------------------------------------------------------------------------------- what counts, and how


def test_a_self_loop_adds_nothing_to_a_cut_and_this_is_said(write):
    problem = read_problem(write("a.txt", "3 3\n1 2 1\n2 2 9\n2 3 1\n"))
    check(problem, *[lambda x, sign=s: sign * cut(x, [(1, 2, 1), (2, 3, 1)]) for s in (-1, 1)])
    assert problem.remarks[0].startswith("1 self-loop (line 3: 2 2 9): adds nothing to a cut.")


def test_pairs_listed_twice_add_up_and_this_is_said(write):
    cases = [
        ("a.txt", "3 4\n1 2 1\n2 1 1\n2 3 1\n3 2 1\n", "2 of the 4 entries list a pair in the other direction"),
        ("a.txt", "3 2\n1 2 1\n1 2 1\n", "1 of the 2 entries list a pair again:"),
        (
            "a.coo",
            "0 0 1\n0 0 1\n0 1 2\n1 0 3\n",
            "2 of the 4 entries list a pair again or in the other direction:",
        ),
        ("a.coo", "0 0 1\n0 1 2\n", None),
    ]
    for name, text, remark in cases:
        problem = read_problem(write(name, text))
        assert [r.startswith(remark or "-") for r in problem.remarks] == ([True] if remark else [])
        energies = problem.problem.energy(states(problem.problem.n))
        if name == "a.coo":
            assert energies.max() == sum(int(line.split()[2]) for line in text.splitlines())


@pytest.mark.parametrize("mark", ["c made by rudy", "c", "# made by rudy", "% made by rudy", "// made by rudy"])
def test_comments_before_the_header_and_between_the_lines(write, mark):
    problem = read_problem(write("G.txt", f"{mark}\n\n{mark}\n3 2\n1 2 1\n{mark}\n2 3 1\n{mark}\n"))
    check(problem, *[lambda x, sign=s: sign * cut(x, [(1, 2, 1), (2, 3, 1)]) for s in (-1, 1)])
    assert problem.format == "gset"


def test_unused_variables_cost_nothing(write):
    problem = read_problem(write("a.coo", "0 9999998 -1\n"))
    assert (problem.n, problem.problem.n, problem.n_unused) == (9_999_999, 2, 9_999_997)
    solution = BruteForce().minimise(problem.problem, generator=rng.stream(0, "solver"))
    answer = Answer.of(problem, solution)
    assert np.flatnonzero(answer.assignment).tolist() == [0, 9_999_998]
    assert (answer.score, answer.optimal) == ((-1, 0), True)
    assert problem.score(answer.assignment) == problem.score(solution.best)
    with pytest.raises(SettingError, match=r"shape of x = \(3,\) is not allowed: expected \(9999999,\) or \(2,\)"):
        problem.score(torch.zeros(3))


# ------------------------------------------------------------------------------------------------ clauses

CLAUSES = [[1, 2], [-1], [-1, -2, 3], [3, -2], [2, -3, 3], [1, 1]]


def unsatisfied(x, weights):
    false = [not any((x[abs(q) - 1] == 1) == (q > 0) for q in clause) for clause in CLAUSES]
    return sum(weight for weight, is_false in zip(weights, false, strict=True) if is_false), false


def listed(clauses, prefixes):
    return "\n".join(f"{p} {' '.join(map(str, c))} 0" for p, c in zip(prefixes, clauses, strict=True))


def test_cnf(write):
    text = f"c a comment\np cnf 3 6\n{listed(CLAUSES, [''] * 6)}\n"
    problem = read_problem(write("a.cnf", text))
    assert isinstance(problem.problem, WeightedMaxSat)
    check(problem, *[lambda x: unsatisfied(x, [1] * 6)[0]] * 2)
    assert problem.sizes == {"variables": 3, "clauses": 6}
    assert problem.objective.name == "unsatisfied clauses"


def test_cnf_with_clauses_across_lines_and_the_end_mark_of_satlib(write):
    text = "p cnf 3 6\n1 2 0 -1 0 -1\n-2 3 0\n3 -2 0 2 -3 3 0\n1 1\n0\n%\n0\n\n"
    check(read_problem(write("a.cnf", text)), *[lambda x: unsatisfied(x, [1] * 6)[0]] * 2)


WCNF = {
    "old": f"p wcnf 3 6 30\n{listed(CLAUSES, [30, 2, 31, 0.5, 4, 3])}",
    "new": f"c {{json}}\n{listed(CLAUSES, ['h', 2, 'h', 0.5, 4, 3])}",
}


@pytest.mark.parametrize("era", WCNF)
@pytest.mark.parametrize("name", ["a.wcnf", "a.txt"])
def test_wcnf(write, name, era):
    problem = read_problem(write(name, WCNF[era]))
    soft, hard = [0, 2, 0, 0.5, 4, 3], [True, False, True, False, False, False]
    above = 1 + sum(soft)

    def energy(x):
        weight, false = unsatisfied(x, soft)
        return weight + above * sum(f and h for f, h in zip(false, hard, strict=True))

    check(problem, energy, lambda x: unsatisfied(x, soft)[0])
    for x in states(3):
        broken = sum(f and h for f, h in zip(unsatisfied(x.tolist(), soft)[1], hard, strict=True))
        assert problem.score(x).hard_unsatisfied == broken
    assert problem.sizes == {"variables": 3, "clauses": 6, "hard_clauses": 2}


def test_breaking_a_hard_clause_never_pays(write):
    problem = read_problem(write("a.wcnf", "h 1 0\n5 -1 0\n7 -1 2 0\n1000 -2 0\n"))
    energy = problem.problem.energy(states(2))
    assert energy[2:].max() < energy[:2].min()


def test_wcnf_without_top_has_no_hard_clauses(write):
    problem = read_problem(write("a.wcnf", "p wcnf 2 2\n9 1 0\n1 -1 2 0\n"))
    assert problem.sizes == {"variables": 2, "clauses": 2}


def test_empty_clauses_are_never_satisfied(write):
    problem = read_problem(write("a.wcnf", "3 0\n2 1 0\n"))
    check(problem, lambda x: 3 + 2 * (1 - x[0]), lambda x: 3 + 2 * (1 - x[0]))


@pytest.mark.parametrize("text", ["p cnf 0 0\n", "p cnf 3 0\n", "c\np cnf 0 0\n%\n0\n"])
def test_an_empty_formula_is_satisfied(write, text):
    problem = read_problem(write("a.cnf", text))
    assert problem.problem.n == 0
    assert problem.score(torch.zeros(problem.n)) == (0, 0)


@pytest.mark.parametrize(
    ("text", "score"),
    [("p cnf 0 1\n0\n", (1, 0)), ("3 0\n", (3, 0)), ("h 0\n", (0, 1)), ("p wcnf 0 0\n", (0, 0)), ("c\n", (0, 0))],
)
def test_formulas_without_literals(write, text, score):
    problem = read_problem(write("a.wcnf" if "cnf 0 1" not in text else "a.cnf", text))
    assert problem.score(torch.zeros(0)) == score
    assert any("empty" in remark for remark in problem.remarks) == (not text.startswith(("3", "p cnf")))


def test_top_is_compared_as_an_integer(write):
    problem = read_problem(write("a.wcnf", f"p wcnf 1 2 {2**53 + 1}\n{2**53} 1 0\n{2**53 + 1} -1 0\n"))
    assert problem.sizes["hard_clauses"] == 1
    assert problem.score(torch.zeros(1)) == (2**53, 0)


# ---------------------------------------------------------------------------------- qbsolv, Matrix Market


@pytest.mark.parametrize("maximise", [False, True])
@pytest.mark.parametrize("name", ["a.qubo", "a.txt"])
def test_qbsolv(write, name, maximise):
    nodes, couplers = [(0, 0, -1), (2, 2, 2.5)], [(0, 1, 3), (1, 2, -4), (2, 0, 1)]
    rows = "\n".join(f"{i} {j} {q}" for i, j, q in nodes + couplers)
    problem = read_problem(write(name, f"c by hand\np qubo 0 4 2 3\nc nodes\n{rows}\n"), maximise=maximise)

    def objective(x):
        return sum(q * x[i] * x[j] for i, j, q in nodes + couplers)

    check(problem, lambda x: -objective(x) if maximise else objective(x), objective)
    assert (problem.format, problem.n, problem.n_unused) == ("qbsolv", 4, 1)


def test_constants_in_comments_of_qbsolv_are_counted(write):
    problem = read_problem(write("a.qubo", "c offset = 2.5\np qubo chimera 2 1 0\n0 0 1\n"))
    check(problem, lambda x: 2.5 + x[0], lambda x: 2.5 + x[0])
    assert problem.remarks == ("The offset 2.5 is counted.", "The topology 'chimera' is not read.")


MATRICES = {
    "integers": "coordinate integer general\n% c\n3 3 4\n2 1 5\n1 2 -2\n3 3 -7\n3 1 4\n",
    "one triangle": "coordinate real symmetric\n3 3 3\n2 1 5\n3 2 -5.5\n1 1 1e-1\n",
    "pattern": "coordinate pattern symmetric\n3 3 2\n2 1\n3 3\n",
    "all entries": "array real general\n3 3\n1\n2\n3\n-4\n5\n6\n-7\n8\n.5\n",
    "all of a triangle": "array integer symmetric\n3 3\n1\n2\n-3\n4\n-5\n6\n",
}


@pytest.mark.parametrize("name", ["a.mtx", "a"])
@pytest.mark.parametrize("kind", MATRICES)
def test_matrix_market_as_scipy_reads_it(write, kind, name):
    text = f"%%MatrixMarket matrix {MATRICES[kind]}"
    problem = read_problem(write(name, text))
    read = mmread(io.BytesIO(text.encode()))
    matrix = read if isinstance(read, np.ndarray) else read.toarray()
    check(problem, *[lambda x: float(np.array(x) @ matrix @ np.array(x))] * 2)
    assert any("counts twice" in remark for remark in problem.remarks) == ("symmetric" in text)


# ------------------------------------------------------------------------------------------------ RBM


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int64])
def test_rbm(tmp_path, dtype):
    weight = np.array([[1, -2, 3], [-4, 5, 6]]).astype(dtype)
    b, c = np.array([1, -1, 2]).astype(dtype), np.array([-3, 1]).astype(dtype)
    np.savez(tmp_path / "rbm.npz", weight=weight, b=b, c=c, comment=np.array("any"))
    problem = read_problem(tmp_path / "rbm.npz")

    def energy(x):
        v, h = np.array(x[:3]), np.array(x[3:])
        return float(-h @ weight @ v - b @ v - c @ h)

    check(problem, energy, energy)
    assert problem.sizes == {"variables": 5, "couplings": 6}


def test_rbm_of_the_package(tmp_path):
    rbm = RBM(4, 3)
    np.savez_compressed(tmp_path / "rbm.npz", **{name: t.numpy() for name, t in rbm.state_dict().items()})
    problem = read_problem(tmp_path / "rbm.npz").problem
    x = (rng.uniform((9, 7), generator=rng.stream(0, "states"), like=torch.zeros(())) < 0.5).float()
    torch.testing.assert_close(torch.as_tensor(problem.energy(x)).float(), rbm.energy(x[:, :4], x[:, 4:]).detach())


# ------------------------------------------------------------------------------------------------ every format


@pytest.mark.parametrize(
    ("name", "text"),
    [("G1.txt", "2 1\n1 2 1\n"), ("a.b.sparse", "2 1\n1 2 1\n"), ("a.coo", "0 1 1\n"), ("a.wcnf", "h 1 2 0\n")],
)
def test_packed_files_have_the_name_and_energies_of_the_others(write, name, text):
    plain = read_problem(write(name, text))
    for suffix, compress in ((".gz", gzip.compress), (".XZ", lzma.compress), (".bz2", bz2.compress)):
        packed = read_problem(write(f"{name}{suffix}", compress(text.encode())))
        assert packed.name == plain.name == name.rpartition(".")[0]
        assert packed.format == plain.format
        assert np.array_equal(packed.problem.energy(states(2)), plain.problem.energy(states(2)))
        assert read_problem(write(name, compress(text.encode()))).format == plain.format, "told by its first bytes"


@pytest.mark.parametrize(("number", "unit"), [("3", 1.0), ("0.5", 0.1), ("-1.250", 0.01)])
def test_sums_are_multiples_of_the_last_digit(write, number, unit):
    assert read_problem(write("a.gset", f"2 1\n1 2 {number}\n"), "gset").objective.counting.unit == unit


def test_a_small_packed_file_may_be_thousands_of_times_as_large(write):
    packed = lzma.compress(b"p cnf 1 1\n1 0\n" + b" " * 2**21)
    assert 2000 * len(packed) < 2**21
    assert read_problem(write("a.cnf.xz", packed)).n == 1


def test_a_packed_file_may_not_fill_the_memory(write, monkeypatch):
    monkeypatch.setattr("memcomp_lightning.problems.files.source.MOST_UNPACKED", 1000)
    assert read_problem(write("a.cnf.xz", lzma.compress(b"p cnf 1 1\n1 0\n" + b" " * 900))).n == 1
    with pytest.raises(ProblemFileError, match="packed into it, expected at most so much"):
        read_problem(write("a.cnf.xz", lzma.compress(b"p cnf 1 1\n1 0\n" + b" " * 10**6)))


def test_format_is_told_by_the_option_first(write):
    path = write("b.dat", "2 1\n1 2 3\n")
    assert read_problem(path, "gset").problem.energy(torch.tensor([[1.0, 1.0]])).item() == 0
    assert read_problem(str(path), format="beasley").problem.energy(torch.tensor([[1.0, 1.0]])).item() == 6


def test_a_byte_order_mark_and_odd_letters_in_comments_do_no_harm(write):
    text = "\ufeffc Ångström …\np cnf 1 1\n1 0\n"
    assert read_problem(write("a.cnf", text)).sizes == {"variables": 1, "clauses": 1}


def test_a_million_couplings_take_seconds(write):
    lines = "".join(f"{i} {j} -1\n" for i in range(1, 2001) for j in range(2001, 2501))
    path = write("big.txt", f"2500 1000000\n{lines}")
    begin = time.process_time()
    problem = read_problem(path)
    assert time.process_time() - begin < 15, "a few seconds"
    assert problem.sizes["couplings"] == 1_000_000


# ------------------------------------------------------------------------------------------------ faults


MTX = "%%MatrixMarket matrix coordinate"
FAULTS = {
    # name, content, line (None: of the whole file), what was found, what was expected
    "empty": ("G.txt", "", None, "an empty file", "a problem"),
    "blank": ("G.txt", "\n \n", None, "an empty file", "a problem"),
    "binary": ("G.txt", b"\x00\x01\x02" * 99, None, "binary data", "a text file"),
    "garbage": ("G.txt", b"\xff\xfe\x80\x81\n" * 9, None, "first lines of no known format", "format=NAME"),
    "suffix": ("G.json", "{}", None, "the suffix .json", "gset (.gset, .mc, .rud: G-set"),
    "gset header": ("G.mc", "three 2\n1 2 1\n", 1, "'three 2'", "the numbers of vertices and edges"),
    "gset one number": ("G.mc", "3\n1 2 1\n", 1, "'3'", "the numbers of vertices and edges"),
    "gset no variables": ("G.txt", "0 1\n1 2 1\n", 1, "'0 1'", "a number of variables from 1 to"),
    "gset far too many": ("G.txt", f"{10**12} 1\n1 2 1\n", 1, f"'{10**12} 1'", "from 1 to 10000000"),
    "gset above": ("G.txt", "3 2\n\n1 2 1\n1 4 1\n", 4, "'1 4 1'", "two vertices, integers from 1 to 3"),
    "gset below": ("G.txt", "3 2\n0 2 1\n1 2 1\n", 2, "'0 2 1'", "integers from 1 to 3"),
    "gset fraction": ("G.txt", "3 1\n1 2.5 1\n", 2, "'1 2.5 1'", "integers from 1 to 3"),
    "gset too few": ("G.txt", "3 3\n1 2 1\n1 3 1\n", None, "2 edges", "3, the second number of line 1"),
    "gset too many": ("G.txt", "3 1\n1 2 1\n1 3 1\n", None, "2 edges", "1, the second number of line 1"),
    "gset word": ("G.txt", "3 2\n1 2 1\n1 x 1\n", 3, "'1 x 1'", "3 numbers"),
    "gset ragged": ("G.txt", "3 2\n1 2 1\n1 3\n", 3, "'1 3'", "3 numbers"),
    "gset ragged the other way": ("G.txt", "3 2\n1 2\n1 3 1\n", 3, "'1 3 1'", "2 numbers"),
    "gset one column": ("G.txt", "3 2\n1\n2\n", 2, "'1'", "3 numbers"),
    "gset four columns": ("G.txt", "3 1\n1 2 1 1\n", 2, "'1 2 1 1'", "3 numbers"),
    "gset nan": ("G.txt", "3 2\n1 2 1\n1 3 nan\n", 3, "'1 3 nan'", "finite numbers"),
    "gset infinity": ("G.txt", "3 2\n1 2 -inf\n1 3 1\n", 2, "'1 2 -inf'", "finite numbers"),
    "gset overflow": ("G.txt", "3 1\n1 2 1e999\n", 2, "'1 2 1e999'", "finite numbers"),
    "gset hexadecimal": ("G.txt", "3 1\n1 2 0x1\n", 2, "'1 2 0x1'", "3 numbers"),
    "long line": ("G.txt", f"3 1\n{'1 2 1 ' * 50}\n", 2, f"'{'1 2 1 ' * 9}1 2...'", "3 numbers"),
    "beasley lower": ("b.sparse", "3 1\n2 1 5\n", 2, "'2 1 5'", "i <= j"),
    "beasley no value": ("b.sparse", "3 1\n1 2\n", 2, "'1 2'", "3 numbers"),
    "beasley count": ("b.sparse", "3 2\n1 2 1\n", None, "1 entries", "2, the second number of line 1"),
    "beasley above": ("b.sparse", "3 1\n1 4 5\n", 2, "'1 4 5'", "two variables, integers from 1 to 3"),
    "coo negative": ("a.coo", "0 0 1\n-1 0 1\n", 2, "'-1 0 1'", "two variables, integers from 0"),
    "coo vartype": ("a.coo", "# vartype=INTEGER\n0 0 1\n", 1, "'vartype=INTEGER'", "'# vartype=BINARY'"),
    "coo two vartypes": (
        "a.coo",
        "# vartype=SPIN\n0 0 1 # vartype=BINARY\n",
        2,
        "BINARY, but SPIN in line 1",
        "one",
    ),
    "coo spins": ("a.coo", "# a spin glass\n0 0 1\n", 1, "'a spin glass'", "also a comment '# vartype=SPIN'"),
    "coo ising": ("a.coo", "0 0 1\n# ISING\n", 2, "'ISING'", "also a comment '# vartype=SPIN'"),
    "coo empty vartype": ("a.coo", "# vartype\n0 0 1\n", 1, "'vartype'", "'# vartype=SPIN'"),
    "coo offset": ("a.coo", "# offset=abc\n0 0 1\n", 1, "'offset=abc'", "'offset=NUMBER'"),
    "coo offset with comma": ("a.coo", "# offset=1,000\n0 0 1\n", 1, "'offset=1,000'", "'offset=NUMBER'"),
    "coo two offsets": ("a.coo", "# offset=1\n# constant: 2\n0 0 1\n", 2, "2, but 1 in line 1", "one of them"),
    "coo infinite offset": ("a.coo", "# offset=1e999\n0 0 1\n", None, "offset '1e999'", "that float64 can hold"),
    "coo nothing": ("a.coo", "# my model\n", None, "no entries", "'i j bias'"),
    "three numbers": ("a.txt", "4 3 1\n1 2 5\n2 3 5\n3 4 5\n", 1, "'4 3 1', which may be a header", "format=coo"),
    "three numbers, 0": ("a", "4 2 1\n0 1 5\n2 3 5\n", 1, "'4 2 1', which may be a header", "format=gset"),
    "no header, no 0": ("a.txt", "# x\n1 2 5\n2 3 5\n", 2, "'1 2 5', which may be a header", "format=beasley"),
    "empty clause or graph": ("a.txt", "c x\n3 0\n", 2, "'3 0', which may be an empty clause", "format=gset"),
    "gset underflow": ("G.txt", "3 1\n1 2 1e-400\n", 2, "'1 2 1e-400'", "a number that float64 can hold"),
    "gset underscore": ("G.txt", "3 1\n1 2 1_0\n", 2, "'1 2 1_0'", "3 numbers"),
    "gset foreign digits": ("G.txt", "3 1\n1 2 ٣\n", 2, "'1 2", "3 numbers"),
    "gset infinite sum": ("G.txt", "3 1\n1 2 1e308\n", None, "numbers whose sums reach about 1e", "below 1e307"),
    "wcnf infinite sum": ("a.wcnf", "1e307 1 0\n1e307 1 0\n", None, "numbers whose sums reach about 1e", "below"),
    "qbsolv header": ("a.qubo", "p qubo 0 2 1\n0 0 1\n", 1, "'p qubo 0 2 1'", "'p qubo 0 n n_nodes"),
    "qbsolv counts": ("a.qubo", "p qubo 0 2 1 1\n0 0 1\n", None, "1 nodes 'i i q' and 0 couplers", "1 and 1"),
    "qbsolv above": ("a.qubo", "p qubo 0 2 0 1\n0 2 1\n", 2, "'0 2 1'", "integers from 0 to 1"),
    "mtx banner": ("a.mtx", "2 2 1\n1 1 1\n", 1, "'2 2 1'", "'%%MatrixMarket matrix coordinate real symmetric'"),
    "mtx complex": ("a.mtx", f"{MTX} complex general\n1 1 1\n1 1 1 0\n", 1, "'complex'", "integer or real"),
    "mtx skew": ("a.mtx", f"{MTX} real skew-symmetric\n2 2 1\n2 1 3\n", 1, "'skew-symmetric'", "general or"),
    "mtx oblong": ("a.mtx", f"{MTX} real general\n2 3 1\n2 1 3\n", 2, "'2 3 1'", "of a square matrix"),
    "mtx upper": ("a.mtx", f"{MTX} real symmetric\n2 2 1\n1 2 3\n", 3, "'1 2 3'", "i >= j, the lower triangle"),
    "mtx count": ("a.mtx", f"{MTX} real general\n2 2 2\n2 1 3\n", None, "1 entries", "2, as line 2 says"),
    "cnf underscore": ("a.cnf", "p cnf 20 1\n1_0 0\n", 2, "'1_0 0'", "literals, integers"),
    "cnf without variables": ("a.cnf", "p cnf 0 1\n1 0\n", 2, "literal 1", "no variables"),
    "wcnf top 0": ("a.wcnf", "p wcnf 1 1 0\n1 1 0\n", 1, "top 0", "a number > 0"),
    "xz cut": (
        "G.txt.xz",
        lzma.compress(b"3 1\n1 2 1\n")[:-9],
        None,
        "Compressed file ended",
        "complete xz stream",
    ),
    "bzip2 cut": ("G.txt.bz2", bz2.compress(b"3 1\n1 2 1\n")[:-9], None, "Compressed file", "complete bzip2"),
    "xz by name only": ("G.txt.xz", "3 1\n1 2 1\n", None, "Input format not supported", "a complete xz stream"),
    "coo word": ("a.coo", "# vartype=SPIN\n0 0 1\n0 1 one # it\n", 3, "'0 1 one # it'", "3 numbers"),
    "cnf header": ("a.cnf", "1 2 0\n", 1, "'1 2 0'", "'p cnf n m'"),
    "cnf weights": ("a.cnf", "c\np wcnf 2 1 3\n1 2 0\n", 2, "'p wcnf 2 1 3'", "format=wcnf"),
    "cnf short header": ("a.cnf", "p cnf 2\n1 2 0\n", 1, "'p cnf 2'", "'p cnf n m'"),
    "cnf header words": ("a.cnf", "p cnf two 1\n1 2 0\n", 1, "'two 1'", "a number of variables"),
    "cnf comments": ("a.cnf", "c nothing\nc at all\n", None, "nothing but comments", "clauses"),
    "cnf literal": ("a.cnf", "p cnf 2 2\n1 2 0\n1 -3 0\n", 3, "literal -3", "variables from 1 to 2"),
    "cnf word": ("a.cnf", "p cnf 2 1\n1 b 0\n", 2, "'1 b 0'", "literals, integers"),
    "cnf fraction": ("a.cnf", "p cnf 2 1\n1 2.0 0\n", 2, "'1 2.0 0'", "literals, integers"),
    "cnf open": ("a.cnf", "p cnf 2 2\n1 2 0\n1\n-2\n", 3, "a clause without its closing 0", "a 0 after"),
    "cnf open inside": (
        "a.cnf",
        "p cnf 2 2\n1 2\n-1 0\n",
        None,
        "1 clauses",
        "m = 2 of line 1 (line 2 does not end",
    ),
    "cnf count": ("a.cnf", "p cnf 2 3\n1 2 0\n-1 0\n", None, "2 clauses", "m = 3 of line 1"),
    "wcnf open": (
        "a.wcnf",
        "p wcnf 2 2 9\n9 1 2\n1 -1 0\n",
        2,
        "a clause without its closing 0",
        "a 0 at the end",
    ),
    "wcnf two": ("a.wcnf", "h 1 0 3 2 0\n", 1, "a 0 inside a clause", "one clause a line"),
    "wcnf weight": ("a.wcnf", "h 1 0\n-3 1 2 0\n", 2, "'-3'", "a weight >= 0, or h for a hard clause"),
    "wcnf nan": ("a.wcnf", "nan 1 0\n", 1, "'nan'", "a weight >= 0"),
    "wcnf infinite": ("a.wcnf", "1e999 1 0\n", 1, "'1e999'", "a weight >= 0"),
    "wcnf h with top": ("a.wcnf", "p wcnf 2 1 9\nh 1 0\n", 2, "'h'", "a weight >= 0."),
    "wcnf literal": ("a.wcnf", "p wcnf 2 1 9\n1 3 0\n", 2, "literal 3", "variables from 1 to 2"),
    "wcnf count": ("a.wcnf", "p wcnf 2 3 9\n1 2 0\n", None, "1 clauses", "m = 3 of line 1"),
    "wcnf header": ("a.wcnf", "p cnf 2 1\n1 2 0\n", 1, "'p cnf 2 1'", "format=cnf"),
    "wcnf top": ("a.wcnf", "p wcnf 2 1 top\n1 2 0\n", 1, "'top'", "a number for top"),
    "wcnf lone weight": ("a.wcnf", "h 1 0\n5\n", 2, "a clause without its closing 0", "a 0 at the end"),
    "wcnf late header": ("a.wcnf", "h 1 0\np wcnf 2 1 9\n", 2, "'p'", "a weight >= 0"),
    "npz of text": ("a.npz", "3 2\n", None, "no readable arrays", "an .npz archive"),
    "npz cut": ("a.npz", b"PK\x03\x04" + bytes(30), None, "no readable arrays", "an .npz archive"),
    "gzip cut": ("G.txt.gz", gzip.compress(b"3 1\n1 2 1\n")[:-9], None, "", "a complete gzip stream"),
    "gzip by name only": ("G.txt.gz", "3 1\n1 2 1\n", None, "Not a gzipped file", "a complete gzip stream"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_fault_is_named_in_one_line(write, case):
    name, content, line, found, expected = FAULTS[case]
    path = write(name, content)
    with pytest.raises(ProblemFileError) as error:
        read_problem(path)
    message = str(error.value)
    assert message.startswith(f"{path}: found {found}" if line is None else f"{path}, line {line}: found {found}")
    assert f"expected {expected}" in message or (expected in message and ", expected " in message)
    assert message.endswith(".")
    assert "\n" not in message


RBM_FAULTS = {
    "missing": (
        {"w": (2, 3), "b": (3,), "c": (2,)},
        "found 'w', 'b', 'c', expected the arrays 'weight', 'b' and 'c'",
    ),
    "b": (
        {"weight": (2, 3), "b": (2,), "c": (2,)},
        r"found b of shape \(2,\), expected \(3,\), as weight is \(2, 3\)",
    ),
    "c": (
        {"weight": (2, 3), "b": (3,), "c": (3,)},
        r"found c of shape \(3,\), expected \(2,\), as weight is \(2, 3\)",
    ),
    "swapped": ({"weight": (3, 2), "b": (3,), "c": (2,)}, r"found b of shape \(3,\), expected \(2,\)"),
    "axes": (
        {"weight": (3,), "b": (3,), "c": (2,)},
        r"found weight of shape \(3,\), expected \(n_hidden, n_visible\)",
    ),
    "nothing": ({"weight": (0, 2), "b": (2,), "c": (0,)}, "both >= 1"),
}


@pytest.mark.parametrize("case", RBM_FAULTS)
def test_arrays_of_other_names_or_shapes(tmp_path, case):
    shapes, message = RBM_FAULTS[case]
    np.savez(tmp_path / "rbm.npz", **{name: np.ones(shape) for name, shape in shapes.items()})
    with pytest.raises(ProblemFileError, match=message):
        read_problem(tmp_path / "rbm.npz")


@pytest.mark.parametrize(
    "b", [np.array([1.0, np.nan]), np.array([1, 2j]), np.array(["a", "b"]), np.array([1, None], dtype=object)]
)
def test_arrays_of_other_than_finite_numbers(tmp_path, b):
    np.savez(tmp_path / "rbm.npz", weight=np.ones((1, 2)), b=b, c=np.ones(1))
    with pytest.raises(ProblemFileError, match=r"finite numbers|pickle"):
        read_problem(tmp_path / "rbm.npz")


def test_an_array_alone_is_no_archive(tmp_path):
    np.save(tmp_path / "a.npy", np.ones(2))
    with pytest.raises(ProblemFileError, match=r"expected an \.npz archive"):
        read_problem(tmp_path / "a.npy", "rbm")


def test_missing_file_and_what_is_near(write, tmp_path):
    for name in ("G1.txt", "G14.txt", "notes.md"):
        write(name, "2 0\n")
    with pytest.raises(ProblemFileError, match=r"G11\.txt: there is no such file\. Near it: G1\.txt, G14\.txt\.$"):
        read_problem(tmp_path / "G11.txt")
    with pytest.raises(ProblemFileError, match=r"no such file\. Nothing in the folder .* is called nearly so\.$"):
        read_problem(tmp_path / "zzzzzz")
    with pytest.raises(ProblemFileError, match=r"The folder .*nowhere does not exist either\.$"):
        read_problem(tmp_path / "nowhere" / "G1.txt")
    with pytest.raises(ProblemFileError, match=r"cannot be read \(Is a directory\)"):
        read_problem(tmp_path)


def test_settings_are_refused(write):
    path = write("G.txt", "2 0\n")
    with pytest.raises(SettingError, match="format = 'gest' is not allowed: expected one of 'gset', 'beasley'"):
        read_problem(path, "gest")
    with pytest.raises(
        SettingError, match="maximise = True is not allowed: expected false for a file of format 'cnf'"
    ):
        read_problem(write("a.cnf", "p cnf 1 1\n1 0\n"), maximise=True)


def test_no_two_formats_share_a_suffix():
    suffixes = [suffix for format_ in FORMATS.values() for suffix in format_.suffixes]
    assert len(suffixes) == len(set(suffixes))


# ------------------------------------------------------------------------------------------------ solutions


def test_solution_in_json(write, tmp_path):
    problem = read_problem(write("b.sparse", "3 4\n" + "\n".join(f"{i} {j} {q}" for (i, j), q in ENTRIES.items())))
    assert isinstance(problem.problem, Qubo)
    solution = BruteForce().minimise(problem.problem, generator=rng.stream(0, "solver"))
    write_solution(tmp_path / "s.json", problem, solution, solver={"max_variables": 22}, seed=5)
    content = json.loads((tmp_path / "s.json").read_text())
    best = min(states(3).tolist(), key=quadratic)
    assert content == {
        "problem": {
            "file": str(problem.path),
            "name": "b",
            "format": "beasley",
            "n_variables": 3,
            "n_couplings": 2,
        },
        "energy": quadratic(best),
        "objective": {"name": "x'Qx", "direction": "minimise", "value": quadratic(best)},
        "assignment": best,
        "restarts": {"energy": [quadratic(best)], "status": ["OPTIMAL"], "steps": [8]},
        "wall_time_s": solution.wall_time_s,
        "solver": {"max_variables": 22},
        "seed": 5,
        "memcomp_lightning": __version__,
    }
    assert [file.name for file in tmp_path.iterdir() if file.name.startswith(".")] == []


def solution_of(energies, assignments):
    n_restarts = len(energies)
    return QuboSolution(
        assignments=torch.tensor(assignments),
        energies=torch.tensor(energies, dtype=torch.float64),
        status=torch.tensor([Status.STEP_BUDGET] * (n_restarts - 1) + [Status.NOT_RUN]),
        steps=torch.tensor([7] * (n_restarts - 1) + [0]),
        wall_time_s=0.5,
    )


def test_restarts_that_were_not_run_and_broken_hard_clauses_in_json(write, tmp_path):
    problem = read_problem(write("a.wcnf", "h 1 0\n2 -1 2 0\n1 -2 0\n"))
    solution = solution_of([5.0, 4.0, math.inf], [[0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    write_solution(tmp_path / "s.json", problem, solution, solver={}, seed=0)
    content = json.loads((tmp_path / "s.json").read_text(), parse_constant=pytest.fail)
    assert content["restarts"]["energy"] == [5.0, 4.0, None]
    assert content["restarts"]["status"] == ["NOT_FEASIBLE", "NOT_FEASIBLE", "NOT_RUN"]
    assert content["objective"]["value"] == 0
    assert content["objective"]["hard_clauses_unsatisfied"] == 1
    assert content["problem"]["n_hard_clauses"] == 1


def test_solution_of_several_problems_is_refused(write, tmp_path):
    problem = read_problem(write("G.txt", "2 1\n1 2 1\n"))
    solution = solution_of([0.0, 0.0], [[0.0, 0.0], [0.0, 0.0]])
    several = QuboSolution(
        solution.assignments[None], solution.energies[None], solution.status[None], solution.steps[None], 0.0
    )
    with pytest.raises(SettingError, match=r"\(1, 2\) is not allowed: expected \(n_restarts,\)"):
        write_solution(tmp_path / "s.json", problem, several, solver={}, seed=0)


@pytest.mark.parametrize(
    ("name", "data", "is_one"),
    [
        ("a.coo", b"anything", True),
        ("a.WCNF.gz", b"anything", True),
        ("a.csv", b"2 1\n1 2 1\n", False),
        ("a.txt", b"2 1\n1 2 1\n", True),
        ("G1", b"2 1\n1 2 1\n", True),
        ("Makefile", b"all:\n\ttrue\n", False),
        ("three.txt", b"3 1 1\n1 2 1\n", True),  # of several formats: who reads it is told so
        (".hidden.coo", b"0 1 2\n", False),
    ],
)
def test_which_files_of_a_folder_are_problems(tmp_path, name, data, is_one):
    (tmp_path / name).write_bytes(data)
    assert is_problem_file(tmp_path / name) is is_one
    assert not is_problem_file(tmp_path)


# ------------------------------------------------------------------------------------------------ found by fuzzing


@pytest.mark.parametrize("word", ["0e-999999999", "0.0E+999999999", "-0e-99999999"])
@pytest.mark.parametrize(
    ("name", "text"), [("a.coo", "0 1 {}\n1 2 0.5\n"), ("a.wcnf", "p wcnf 1 2\n{} 1 0\n1 -1 0\n")]
)
def test_a_zero_with_a_huge_power_of_ten_is_zero_at_once(write, name, text, word):
    begin = time.perf_counter()
    problem = read_problem(write(name, text.format(word.lstrip("-") if "wcnf" in name else word)))
    assert problem.score(np.ones(problem.n)).value in (1, 0.5)
    assert time.perf_counter() - begin < 1


def test_clauses_or_entries_among_comments_of_both_kinds(write):
    with pytest.raises(ProblemFileError, match="may be a clause or an entry"):
        read_problem(write("a.txt", "# offset=0\nc words\n1 1 0\n"))
    assert read_problem(write("b.txt", "c words\n1 1 0\n")).format == "wcnf"


@pytest.mark.parametrize("kind", ["general", "symmetric"])
def test_an_array_of_millions_of_rows_that_are_not_there(write, kind):
    path = write("a.mtx", f"%%MatrixMarket matrix array real {kind}\n10000000 10000000\n1\n")
    with pytest.raises(ProblemFileError, match="found 1 entries, expected"):
        read_problem(path)


@pytest.mark.parametrize("suffix", ["gz", "xz", "bz2"])
def test_a_packed_file_that_holds_a_thousand_times_its_size(write, suffix):
    pack = {"gz": gzip, "xz": lzma, "bz2": bz2}[suffix].compress
    path = write(f"a.gset.{suffix}", pack(b"0" * (2**26 + 1)))
    with pytest.raises(ProblemFileError, match="MiB packed into it"):
        read_problem(path)


@pytest.mark.parametrize("sign", [b"\x1c", b"\x1d", b"\x1e", b"\x1f"])
def test_signs_that_python_takes_for_blanks(write, sign):
    with pytest.raises(ProblemFileError, match="no known format"):
        read_problem(write("a.txt", sign + b"# x\n0 1 2\n"))
    with pytest.raises(ProblemFileError, match="line 2"):
        read_problem(write("a.coo", b"0 1 2\n0" + sign + b"2 2\n"))


# ------------------------------------------------------------------------------------------------ real files


@needs_qubo_files
@pytest.mark.parametrize(
    ("name", "n", "m"),
    [
        ("G1.txt", 800, 19176),
        ("G14.txt", 800, 4694),
        ("G22.txt", 2000, 19990),
        ("G32.txt", 2000, 4000),
        ("G43.txt", 1000, 9990),
        ("G55.txt", 5000, 12498),
    ],
)
def test_sizes_of_the_gset(name, n, m):
    assert read_problem(DATA / name).sizes == {"variables": n, "couplings": m}
