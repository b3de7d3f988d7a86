"""``memcomp-solve``: files in, a table, a solution and a picture out; one line where something is wrong."""

import json
import signal
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import torch
from running import Outcome, launch

import memcomp_lightning
from memcomp_lightning.problems import FORMATS, read_problem

Solve = Callable[..., Outcome]
CONF = Path(memcomp_lightning.__file__).parent / "conf"
RUN = "hydra.run.dir=run"
DMM = ["solver=dmm", "solver.max_steps=40", "solver.n_restarts=4"]


@pytest.fixture(autouse=True)
def files(tmp_path: Path) -> None:
    """One small problem of each format, and a few that are not."""
    ring = "\n".join(f"{i} {i % 5 + 1} 1" for i in range(1, 6))
    (tmp_path / "ring.txt").write_text(f"5 5\n{ring}\n")
    (tmp_path / "b.sparse").write_text("3 3\n1 1 -3\n1 3 2\n2 3 -5\n")
    (tmp_path / "spins.coo").write_text("# vartype=SPIN\n0 0 0.5\n0 1 -1.25\n1 2 2.0\n")
    (tmp_path / "pairs.wcnf").write_text("p wcnf 3 4 10\n10 1 2 0\n2 -1 0\n3 -2 0\n1 3 0\n")
    (tmp_path / "triples.cnf").write_text("p cnf 3 2\n1 2 3 0\n-1 -2 -3 0\n")
    np.savez(tmp_path / "rbm.npz", weight=np.ones((2, 3)), b=-np.ones(3), c=np.ones(2))
    (tmp_path / "three.txt").write_text("3 1 1\n1 2 1\n")
    (tmp_path / "bad.txt").write_text("3 2\n1 2 1\n1 4 1\n")


def left_behind() -> set[str]:
    return {path.name for path in Path.cwd().iterdir() if path.is_dir()}


@pytest.mark.parametrize(
    ("file", "options", "objective", "energy"),
    [
        ("ring.txt", [], 4, -4),
        ("b.sparse", [], -10, -10),
        ("b.sparse", ["maximise=true"], 1, -1),
        ("spins.coo", [], -3.75, -3.75),
        ("pairs.wcnf", [], 2, 2),
        ("rbm.npz", [], -5, -5),
        ("ring.txt", ["format=gset", *DMM], 4, -4),
        ("ring.txt", ["solver=dmm_recorded", *DMM[1:]], 4, -4),
        ("b.sparse", ["solver=brute_force"], -10, -10),
        ("b.sparse", ["solver=alternating_descent"], -10, -10),
    ],
)
def test_solution_is_that_of_the_file(
    memcomp_solve: Solve, file: str, options: list[str], objective: float, energy: float
) -> None:
    outcome = memcomp_solve(f"problem={file}", *options, RUN, "seed=3")
    assert outcome.status == 0, outcome.err
    found = json.loads(Path("run/solution.json").read_text())
    problem = read_problem(file, maximise="maximise=true" in options)
    x = torch.tensor(found["assignment"], dtype=torch.float64)
    assert problem.problem.energy(x[None]).item() == pytest.approx(found["energy"]) == energy
    assert problem.score(x).value == pytest.approx(found["objective"]["value"]) == objective
    assert found["energy"] == min(found["restarts"]["energy"])
    assert found["seed"] == 3
    assert found["problem"]["file"] == file
    assert "".join(map(str, found["assignment"])) in outcome.out
    assert f"{objective:g}  ({found['objective']['direction']})" in outcome.out
    assert "run/solution.json" in outcome.out
    recorded = "solver=dmm_recorded" in options
    assert ("run/trajectory.png" in outcome.out) == recorded
    for picture in ("trajectory.png", "trajectory.svg"):
        assert Path("run", picture).exists() == recorded


def test_clauses_of_three_literals(memcomp_solve: Solve) -> None:
    outcome = memcomp_solve("problem=triples.cnf", *DMM, RUN)
    assert outcome.status == 0, outcome.err
    assert json.loads(Path("run/solution.json").read_text())["objective"]["value"] == 0


def test_table_says_what_a_person_wants_to_know(memcomp_solve: Solve) -> None:
    outcome = memcomp_solve("problem=pairs.wcnf", "solver=alternating_descent", "solver.n_restarts=4", RUN)
    for part in (
        "pairs: 3 variables, 4 clauses (1 hard); format wcnf, pairs.wcnf",
        "weight of unsatisfied soft clauses  2  (minimise)",
        "hard clauses                        0 unsatisfied",
        "of 4 restarts)",
        "4 x CONVERGED",
        "more restarts may find a lower one",
        "wall time",
        "assignment                          101",
    ):
        assert part in outcome.out


def test_integers_are_printed_whole(memcomp_solve: Solve) -> None:
    Path("big.wcnf").write_text(f"{2**54} 1 0\nh -1 0\n" + "3 1 0\n" * 100)
    outcome = memcomp_solve("problem=big.wcnf", "solver=brute_force", RUN)
    assert outcome.status == 0, outcome.err
    assert "Note: Sums reach" in outcome.out, "what float64 does not hold is said"
    assert outcome.out.index("2^53") < outcome.out.index("weight of unsatisfied"), "before the answer"
    for part in (f"soft clauses  {2**54 + 300}  (minimise)", f"{2**54 + 300}  (reached by 1 of 1", "1 x OPTIMAL"):
        assert part in outcome.out
    assert json.loads(Path("run/solution.json").read_text())["objective"]["value"] == 2**54 + 300


@pytest.mark.parametrize(
    ("solver", "status"),
    [
        ("brute_force", "1 x INFEASIBLE"),
        ("best", "x INFEASIBLE"),
        ("annealing", "x NOT_FEASIBLE"),
        ("dmm_recorded", "x NOT_FEASIBLE"),
    ],
)
def test_a_broken_hard_clause_is_no_solution(memcomp_solve: Solve, solver: str, status: str) -> None:
    Path("none.wcnf").write_text("h 1 0\nh -1 0\n4 -2 0\nh 2 1 0\n")
    outcome = memcomp_solve("problem=none.wcnf", f"solver={solver}", RUN)
    assert outcome.status == 3
    assert "1 unsatisfied: this is no solution" in outcome.out
    assert status in outcome.out
    assert "OPTIMAL" not in outcome.out
    found = json.loads(Path("run/solution.json").read_text())
    assert found["objective"] == {**found["objective"], "value": 0, "hard_clauses_unsatisfied": 1}


def test_no_sweep_ends_where_a_problem_has_no_solution(memcomp_solve: Solve) -> None:
    Path("none.wcnf").write_text("h 1 0\nh -1 0\n")
    outcome = memcomp_solve("-m", "problem=none.wcnf,pairs.wcnf", "solver=brute_force", "hydra.sweep.dir=sweep")
    assert "this is no solution" in outcome.out
    assert len(list(Path("sweep").rglob("solution.json"))) == 2


@pytest.mark.parametrize("solver", ["best", "annealing", "tabu", "dmm"])
def test_hard_clauses_hide_nothing(memcomp_solve: Solve, solver: str) -> None:
    """A ring of an even number of nodes and heavy weights on one half: that half is left out of the cover."""
    n = 40
    edges = "".join(f"h {i + 1} {(i + 1) % n + 1} 0\n" for i in range(n))
    Path("ring.wcnf").write_text(edges + "".join(f"{90 + i % 2 * 9} {-i - 1} 0\n" for i in range(n)))
    outcome = memcomp_solve("problem=ring.wcnf", f"solver={solver}", RUN)
    assert outcome.status == 0, outcome.err
    assert f"{90 * n // 2}  (minimise)" in outcome.out


@pytest.mark.parametrize("solver", ["dmm_recorded", "brute_force", "alternating_descent"])
def test_no_variables(memcomp_solve: Solve, solver: str) -> None:
    Path("empty.cnf").write_text("p cnf 0 0\n")
    outcome = memcomp_solve("problem=empty.cnf", f"solver={solver}", RUN)
    assert outcome.status == 0, outcome.err
    assert "1 x OPTIMAL" in outcome.out
    found = json.loads(Path("run/solution.json").read_text())
    assert (found["objective"]["value"], found["assignment"]) == (0, [])


def test_unused_variables_are_free(memcomp_solve: Solve) -> None:
    Path("sparse.coo").write_text("0 200000 -1\n200000 200000 -2\n")
    outcome = memcomp_solve("problem=sparse.coo", RUN)
    assert outcome.status == 0, outcome.err
    assert "Note: 199999 of the variables are not used: they cost nothing, and are reported as 0." in outcome.out
    found = json.loads(Path("run/solution.json").read_text())
    assert found["problem"]["n_unused_variables"] == 199_999
    assert len(found["assignment"]) == 200_001
    assert [i for i, bit in enumerate(found["assignment"]) if bit] == [0, 200_000]


def test_memory_is_said_before_solving(memcomp_solve: Solve, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("path.coo").write_text("".join(f"{i} {i + 1} -1\n" for i in range(50)))
    restarts = ["solver=alternating_descent", "solver.n_restarts=10", "solver.max_sweeps=1", RUN]
    monkeypatch.setattr("memcomp_lightning.solvers.solving._NUMBERS_EACH", 135_000)
    outcome = memcomp_solve("problem=path.coo", *restarts)
    assert "Note: The solver needs about 1 GiB of memory." in outcome.out
    monkeypatch.setattr("memcomp_lightning.solvers.solving._installed", lambda: float(2**29))
    outcome = memcomp_solve("problem=path.coo", *restarts)
    assert outcome.status == 2
    for part in ("path.coo: 51 variables, 50 couplings", "n_restarts = 10 needs about 1 GiB", "fewer restarts"):
        assert part in outcome.err


def test_long_assignments_stay_in_the_file(memcomp_solve: Solve) -> None:
    Path("long.txt").write_text("101 1\n1 101 1\n")
    outcome = memcomp_solve("problem=long.txt", RUN)
    assert "010" not in outcome.out
    assert "run/solution.json  (the assignment, among the rest)" in outcome.out
    assert len(json.loads(Path("run/solution.json").read_text())["assignment"]) == 101


def test_same_seed_same_answer(memcomp_solve: Solve) -> None:
    answers = []
    for seed in (0, 0, 1):
        assert memcomp_solve("problem=ring.txt", "solver=alternating_descent", f"seed={seed}", RUN).status == 0
        answers.append(json.loads(Path("run/solution.json").read_text())["restarts"])
    assert answers[0] == answers[1] != answers[2]


@pytest.mark.parametrize("name", ["a (1), b=c.txt", "it's.txt", "17", "[x].txt"])
def test_files_are_called_as_they_like(memcomp_solve: Solve, name: str) -> None:
    Path("ring.txt").rename(name)
    outcome = memcomp_solve(f"problem={name}", RUN)
    assert outcome.status == 0, outcome.err
    assert json.loads(Path("run/solution.json").read_text())["problem"]["file"] == name


def test_default_folder_is_named_by_date_and_time(memcomp_solve: Solve) -> None:
    assert memcomp_solve("problem=ring.txt", "solver=dmm_recorded", *DMM[1:]).status == 0
    (folder,) = Path("solve").iterdir()
    assert datetime.strptime(folder.name, "%Y-%m-%d_%H-%M-%S-%f")  # two commands of one second keep both solutions
    assert {path.name for path in folder.iterdir()} >= {"solution.json", "trajectory.png", "trajectory.svg"}


def test_every_combination_in_a_multirun(memcomp_solve: Solve) -> None:
    outcome = memcomp_solve("-m", "problem=ring.txt,b.sparse", "seed=0,1", "hydra.sweep.dir=all")
    assert outcome.status == 0, outcome.err
    assert len(list(Path("all").glob("*/solution.json"))) == 4


def test_a_search_keeps_time_states_and_curve(memcomp_solve: Solve) -> None:
    edges = [(i, j) for i in range(1, 31) for j in range(max(1, i - 8), i)]
    pairs = "".join(f"{i} {j} {(7 * i + 3 * j) % 11 - 5}\n" for i, j in edges)
    Path("cut.txt").write_text(f"30 {len(edges)}\n{pairs}")
    best = ["solver=best", "hydra.run.dir=run"]
    outcome = memcomp_solve("problem=cut.txt", *best, "n_solutions=4", "min_distance=2")
    assert outcome.status == 0, outcome.err
    for part in ("AGREED", "lower bound", "no state has a lower energy", "solutions", "4, energies up to -"):
        assert part in outcome.out
    found = json.loads(Path("run/solution.json").read_text())
    assert found["status"] == "AGREED"
    assert found["lower_bound"] <= found["energy"] == found["curve"][-1][1]
    x = np.array([found["assignment"], *(other["assignment"] for other in found["other_solutions"])])
    assert len(x) == 4
    assert all((x[i] != x[j]).sum() >= 2 for i in range(4) for j in range(i))
    energies = [found["energy"], *(other["energy"] for other in found["other_solutions"])]
    problem = read_problem("cut.txt")
    assert energies == sorted(energies) == problem.problem.energy(x).tolist()
    Path("start.txt").write_text("\n".join(map(str, found["assignment"])))
    for start in ("run/solution.json", "start.txt"):
        target = f"target={found['objective']['value']}"
        outcome = memcomp_solve("problem=cut.txt", f"initial={start}", target, best[0], "hydra.run.dir=again")
        assert outcome.status == 0, outcome.err
        again = json.loads(Path("again/solution.json").read_text())
        assert (again["assignment"], again["restarts"]["energy"]) == (found["assignment"], [])
    outcome = memcomp_solve("problem=cut.txt", *best, "time_limit=0.2", "solver.effort=0.1")
    assert len(json.loads(Path("run/solution.json").read_text())["restarts"]["energy"]) > 28


REFUSED = {
    "": ["problem=FILE is missing", "memcomp-solve problem=G1.txt", "beasley", "--help"],
    "problem=": ["problem=FILE is missing"],
    "problem=bad.txt": ["bad.txt, line 3: found '1 4 1', expected two vertices, integers from 1 to 3."],
    "problem=rign.txt": ["rign.txt: there is no such file. Near it: ring.txt"],
    "problem=a=b,c.txt": ["a=b,c.txt: there is no such file."],
    "problem=[]": ["problem=FILE is missing"],
    "-m ring.txt": ["ring.txt is no setting", "Did you mean problem=ring.txt?"],
    "problm=ring.txt": ["problm=ring.txt", "does not exist", "Did you mean problem?"],
    "problem=ring.txt solver.n_restart=3": ["solver.n_restart=3", "Did you mean solver.n_restarts?"],
    "problem=ring.txt solver=dmn": ["Did you mean solver=dmm?", "brute_force, crossover, dimod, dmm"],
    "problem=ring.txt solver=dmm solver.max_steps=0": ["max_steps = 0", "an integer >= 1"],
    "problem=ring.txt solver=dmm solver.field.alpha=nan": ["solver.field.alpha = nan", "a finite number"],
    "problem=ring.txt format=gest": ["format = 'gest'", "'gset'"],
    "problem=ring.txt format=beasley": ["line 6: found '5 1 1', expected i <= j"],
    "problem=ring.txt maximise=1": ["maximise = 1", "true or false"],
    "problem=pairs.wcnf maximise=true": ["maximise = True", "false for a file of format 'wcnf'"],
    "problem=ring.txt seed=1.5": ["seed = 1.5", "an integer"],
    "problem=ring.txt time_limit=0": ["time_limit = 0", "seconds > 0"],
    "problem=ring.txt target=far": ["target = 'far'", "a finite number"],
    "problem=ring.txt n_solutions=0": ["n_solutions = 0"],
    "problem=ring.txt initial=none.json": ["initial=none.json cannot be read"],
    "problem=ring.txt initial=ring.txt": ["shape of initial"],
    "problem=ring.txt initial=rbm.npz": ["initial=rbm.npz holds no state", "zeros and ones"],
    "problem=ring.txt +keep=1": ["setting = 'keep'", "'problem'"],
    "problem=ring.txt model=dbn": ["'model'"],
    "problem=ring.txt hydra.run.dir=/proc/none": ["hydra.run.dir = /proc/none", "no file can be written"],
    "problem=three.txt": ["three.txt, line 1: found '3 1 1'", "format=gset", "format=coo"],
    "problem=ring.txt solver=dmm_recorded solver.max_steps=1000000000": [
        *("solver.record.every = 8", "at least 33", "solver=dmm"),
    ],
    "-m problem=ring.txt,bad.txt": ["bad.txt, line 3", "(job problem=bad.txt)"],
}


@pytest.mark.parametrize("arguments", REFUSED)
def test_refused_in_one_line(memcomp_solve: Solve, arguments: str) -> None:
    outcome = memcomp_solve(*arguments.split())
    assert outcome.status == 2
    assert outcome.out == ""
    assert outcome.err.startswith("memcomp-solve: ")
    assert outcome.err.count("\n") == 1
    for part in REFUSED[arguments]:
        assert part in outcome.err
    assert left_behind() == set(), "a refused command leaves nothing behind"


def test_a_problem_too_large_for_the_solver_ends_in_one_line(memcomp_solve: Solve) -> None:
    outcome = memcomp_solve("problem=ring.txt", "solver=brute_force", "solver.max_variables=3", RUN)
    assert outcome.status == 2
    assert outcome.err.startswith("memcomp-solve: number of variables to enumerate = 5")


def test_help_has_examples_every_format_and_every_solver(memcomp_solve: Solve) -> None:
    outcome = memcomp_solve("--help")
    assert outcome.status == 0
    for part in ("memcomp-solve G1.txt", "--output FILE.csv", "maximise: false", "p wcnf n m top"):
        assert part in outcome.out
    for name, row in FORMATS.items():
        assert f"\n  {name.ljust(8)} " in outcome.out
        assert all(suffix in outcome.out for suffix in row.suffixes)
    for solver in sorted(path.stem for path in (CONF / "solver").glob("*.yaml")):
        assert solver in outcome.out
    assert left_behind() == set()


def test_as_a_process_with_ctrl_c(tmp_path: Path) -> None:
    process = launch(
        "problem=ring.txt", "solver=dmm", "solver.max_steps=10000000", folder=tmp_path, command="solve"
    )
    assert process.stdout.readline().startswith("ring: 5 variables, 5 couplings")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "memcomp-solve: interrupted" in err
    assert "Traceback" not in err
    assert not list(tmp_path.rglob("solution.json"))
