"""``memcomp-solve`` with many problems: one table, which grows, goes on, and has gaps to what is known."""

import csv
import json
import re
import shlex
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from running import Outcome, launch

from memcomp_lightning.cli import batch
from memcomp_lightning.problems import read_problem
from memcomp_lightning.runs import solve_table

Solve = Callable[..., Outcome]
RING = "5 5\n" + "".join(f"{i} {i % 5 + 1} 1\n" for i in range(1, 6))
VALUES = {"b": "-10", "pairs": "2", "ring": "4"}
"""Of the best answers to the files below, by enumeration."""


@pytest.fixture(autouse=True)
def files(tmp_path: Path) -> None:
    """A folder with three problems and what is none."""
    folder = tmp_path / "batch"
    folder.mkdir()
    (folder / "ring.txt").write_text(RING)
    (folder / "b.sparse").write_text("3 3\n1 1 -3\n1 3 2\n2 3 -5\n")
    (folder / "pairs.wcnf").write_text("p wcnf 3 4 10\n10 1 2 0\n2 -1 0\n3 -2 0\n1 3 0\n")
    (folder / "README.md").write_text("Three problems.\n")
    (folder / "notes.txt").write_text("Nothing of interest.\n")


def rows(table: str = "results.csv") -> list[dict[str, str]]:
    with Path(table).open(newline="") as file:
        return list(csv.DictReader(file))


def without_time(table: str) -> list[dict[str, str]]:
    return [{name: cell for name, cell in row.items() if name != "wall_time_s"} for row in rows(table)]


FORMS = {
    "files": ["batch/ring.txt", "batch/b.sparse", "batch/pairs.wcnf"],
    "folder": ["batch"],
    "pattern": ["batch/r[a-z]ng.*", "batch/*.s*", "batch/pairs.wcnf"],
    "problem list": ["problem=[batch/ring.txt,batch/b.sparse,batch/pairs.wcnf]"],
    "problem commas": ["problem=batch/ring.txt,batch/b.sparse,batch/pairs.wcnf"],
    "problem folder": ["problem=batch"],
    "problem pattern": ["problem=batch/ring*", "problem=batch/*.s*", "problem=batch/*.wcnf"],
    "problem glob": ["problem=glob([batch/*.sparse,batch/*.wcnf,batch/ring.txt])"],
}


@pytest.mark.parametrize("form", FORMS)
def test_one_row_for_each_problem_however_they_are_named(memcomp_solve: Solve, form: str) -> None:
    outcome = memcomp_solve(*FORMS[form], "--output", "results.csv")
    assert outcome.status == 0, outcome.err
    found = rows()
    assert {row["problem"]: row["value"] for row in found} == VALUES
    for row in found:
        problem = read_problem(row["file"])
        told = json.loads(Path(row["solution"]).read_text())
        assert str(problem.score(np.array(told["assignment"])).value) == row["value"]
        assert told["problem"]["file"] == row["file"]
        assert (row["solver"], row["seed"], row["gap"], row["error"]) == ("best", "0", "0", "")
    by_name = {row["problem"]: row for row in found}
    assert (by_name["ring"]["direction"], by_name["ring"]["energy"]) == ("maximise", "-4")
    assert (by_name["pairs"]["hard_unsatisfied"], by_name["pairs"]["clauses"]) == ("0", "4")
    assert by_name["b"]["status"] == "OPTIMAL"
    assert "[3/3]" in outcome.out


def test_every_combination_has_a_row_and_solvers_stand_side_by_side(memcomp_solve: Solve) -> None:
    axes = ["solver=best,alternating_descent", "seed=0,1,2"]
    outcome = memcomp_solve("batch", "--output=out/table.csv", *axes)
    assert outcome.status == 0, outcome.err
    found = rows("out/table.csv")
    assert len(found) == 18
    assert [(row["solver"], row["seed"]) for row in found[:4]] == [
        *(("best", seed) for seed in "012"),
        ("alternating_descent", "0"),
    ]
    assert found[0]["file"] == "../batch/b.sparse", "as seen from the table"
    assert Path("out", found[0]["solution"]).exists()
    summary = outcome.out[outcome.out.index("mean gap") :]
    assert "Gaps are to the best of this table." in summary
    assert [line.split()[:2] for line in summary.splitlines()[2:4]] == [
        ["best", "9"],
        ["alternating_descent", "9"],
    ]


def test_settings_tell_rows_of_one_solver_apart(memcomp_solve: Solve) -> None:
    descent = ["batch/ring.txt", "solver=alternating_descent"]
    assert memcomp_solve(*descent, "solver.n_restarts=1,2", "output=results.csv").status == 0
    assert [(row["settings"], row["restarts"]) for row in rows()] == [
        ("solver.n_restarts=1", "1"),
        ("solver.n_restarts=2", "2"),
    ]


def test_without_a_name_the_table_is_in_a_folder_named_by_the_time(memcomp_solve: Solve) -> None:
    assert memcomp_solve("batch").status == 0
    (table,) = Path("solve").glob("*/results.csv")
    assert len(rows(str(table))) == 3
    assert len(list(table.parent.glob("results_solutions/*.json"))) == 3


def test_what_is_done_is_not_done_again(memcomp_solve: Solve) -> None:
    descent = ["solver=alternating_descent", "--output", "results.csv"]
    assert memcomp_solve("batch/ring.txt", *descent).status == 0
    (first,) = rows()
    again = memcomp_solve("batch", *descent)
    assert "1 of 3 answers are in results.csv already." in again.out
    assert "[2/2]" in again.out
    (same,) = (row for row in rows() if row["file"] == first["file"])
    assert same | {"gap": ""} == first | {"gap": ""}, "the row is as it was"
    assert "3 of 3 answers" in memcomp_solve("batch", *descent).out
    Path("batch/ring.txt").write_text(RING.replace(" 1\n", " 3\n"))
    changed = memcomp_solve("batch", *descent)
    assert "2 of 3 answers" in changed.out, "a file with other contents is another problem"
    assert sorted(row["value"] for row in rows()) == ["-10", "12", "2"]


def test_a_file_that_cannot_be_read_costs_its_own_row(memcomp_solve: Solve) -> None:
    Path("batch/bad.txt").write_text("3 2\n1 2 1\n1 4 1\n")
    outcome = memcomp_solve("batch", "--output", "results.csv")
    assert outcome.status == 1
    assert "bad  best  seed=0:  refused. batch/bad.txt, line 3: found '1 4 1'" in outcome.out
    by_name = {row["problem"]: row for row in rows()}
    assert {name: row["value"] for name, row in by_name.items()} == {**VALUES, "bad": ""}
    assert "line 3" in by_name["bad"]["error"]
    Path("batch/bad.txt").write_text("3 2\n1 2 1\n1 3 1\n")
    mended = memcomp_solve("batch", "--output", "results.csv")
    assert (mended.status, len(rows())) == (0, 4)
    assert "3 of 4 answers" in mended.out
    assert {row["problem"]: row["value"] for row in rows()} == {**VALUES, "bad": "2"}


def test_what_a_solver_does_not_take_is_its_own_rows_matter(memcomp_solve: Solve) -> None:
    outcome = memcomp_solve("batch", "solver=best,branch_and_bound", "--output", "results.csv")
    assert outcome.status == 1
    refused = [row for row in rows() if row["error"]]
    assert {row["solver"] for row in refused} == {"branch_and_bound"}
    assert "refused" in outcome.out[outcome.out.index("mean gap") :]


def test_gaps_to_values_beside_the_problems(memcomp_solve: Solve) -> None:
    Path("batch/best_known.csv").write_text("name,value\nring,5\nb,-8.0\nother,17\n")
    outcome = memcomp_solve("batch", "--output", "results.csv")
    assert outcome.status == 0, outcome.err
    found = {row["problem"]: (row["best_known"], row["gap"]) for row in rows()}
    assert found == {"ring": ("5", "0.2"), "b": ("-8.0", "-0.25"), "pairs": ("", "0")}
    assert "Gaps are to best known values, 1 of them to the best of this table." in outcome.out
    Path("mine.csv").write_text("name,value\nring,8\n")
    again = memcomp_solve("batch", "--output", "results.csv", "best_known=mine.csv")
    assert "3 of 3 answers" in again.out
    found = {row["problem"]: (row["best_known"], row["gap"]) for row in rows()}
    assert found == {"ring": ("8", "0.5"), "b": ("", "0"), "pairs": ("", "0")}, "gaps are found anew"


def test_a_broken_hard_clause_has_no_gap(memcomp_solve: Solve) -> None:
    Path("none.wcnf").write_text("h 1 0\nh -1 0\n4 -2 0\n")
    outcome = memcomp_solve("none.wcnf", "solver=brute_force", "--output", "results.csv")
    assert outcome.status == 3
    (row,) = rows()
    assert (row["hard_unsatisfied"], row["gap"]) == ("1", "")
    assert "1 hard clauses broken" in outcome.out


def test_several_processes_make_the_same_rows(memcomp_solve: Solve) -> None:
    axes = ["solver=best,annealing", "seed=0,1", "solver.n_restarts=8"]
    assert memcomp_solve("batch", *axes, "--output", "one/results.csv").status == 0
    outcome = memcomp_solve("batch", *axes, "--output", "two/results.csv", "workers=2")
    assert outcome.status == 0, outcome.err
    assert without_time("one/results.csv") == without_time("two/results.csv")


def test_the_figure_is_drawn_where_it_is_asked_for(memcomp_solve: Solve) -> None:
    outcome = memcomp_solve("batch", "solver=best,tabu", "--output", "results.csv", "--figure", "pictures/gap.png")
    assert outcome.status == 0, outcome.err
    assert Path("pictures/gap.png").read_bytes().startswith(b"\x89PNG")
    assert "pictures/gap.png" in outcome.out


def test_one_problem_beside_the_settings_is_a_run_of_its_own(memcomp_solve: Solve) -> None:
    outcome = memcomp_solve("batch/ring.txt", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert json.loads(Path("run/solution.json").read_text())["objective"]["value"] == 4
    assert not list(Path().glob("*.csv"))


def test_a_file_is_read_anew_where_it_has_changed(
    memcomp_solve: Solve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One process solves ``ring.txt``, what stands there later, and a file of the same name in another folder."""

    def value() -> int:
        assert memcomp_solve("ring.txt", "hydra.run.dir=run").status == 0
        found: int = json.loads(Path("run/solution.json").read_text())["objective"]["value"]
        return found

    monkeypatch.chdir(tmp_path / "batch")
    assert value() == 4
    Path("ring.txt").write_text(RING.replace(" 1\n", " 3\n"))
    assert value() == 12
    (tmp_path / "other").mkdir()
    (tmp_path / "other/ring.txt").write_text(RING.replace(" 1\n", " 7\n"))
    monkeypatch.chdir(tmp_path / "other")
    assert value() == 28


REFUSED = {
    "none/*.coo": ["none/*.coo stands for no file of a problem in "],
    "problem=glob(*.coo)": ["glob(*.coo) stands for no file"],
    "empty --output x.csv": ["empty stands for no file"],
    "batch/ring.txt batch/rign.txt": ["batch/rign.txt: there is no such file. Near it: ring.txt"],
    "solver=best,dmm": ["problem=FILE is missing"],
    "batch --output results": ["output = 'results'", "a file *.csv"],
    "batch --output": ["--output has no value: write --output VALUE."],
    "batch --output batch/README.csv": ["batch/README.csv is no table", "--output FILE"],
    "batch --figure gap.txt": ["figure = 'gap.txt'", "*.png or *.svg or *.pdf"],
    "batch workers=0": ["workers = 0", "an integer >= 1"],
    "batch --workers=two": ["workers = 'two'", "an integer >= 1"],
    "batch best_known=none.csv": ["best_known=none.csv cannot be read"],
    "batch best_known=batch/notes.txt": ["best_known=batch/notes.txt: expected name,value in its first line"],
    "batch best_known=bad.csv": ["bad.csv, line 3: found 'ring,four', expected a problem's name and a number."],
    "batch best_known=twice.csv": ["twice.csv, line 3: ring stands there a second time."],
    "batch solver=best,dmn": ["Did you mean solver=dmm?"],
    "batch solver=dmm solver.max_steps=0": ["max_steps = 0", "an integer >= 1"],
    "batch solver=dmm,best solver.max_steps=9": ["solver.max_steps=9", "(job solver=best"],
    "-m problem=batch/ring.txt --output x.csv": ["-m gives each job a folder of its own"],
}


@pytest.mark.parametrize("arguments", REFUSED)
def test_refused_in_one_line_before_anything_is_solved(memcomp_solve: Solve, arguments: str) -> None:
    Path("empty").mkdir()
    Path("batch/README.csv").write_text("a,b\n1,2\n")
    Path("bad.csv").write_text("name,value\nb,-10\nring,four\n")
    Path("twice.csv").write_text("name,value\nring,4\nring,5\n")
    before = set(Path().rglob("*"))
    outcome = memcomp_solve(*arguments.split())
    assert (outcome.status, outcome.out) == (2, "")
    assert outcome.err.startswith("memcomp-solve: ")
    assert outcome.err.count("\n") == 1
    for part in REFUSED[arguments]:
        assert part in outcome.err
    assert set(Path().rglob("*")) == before


@pytest.mark.parametrize("workers", [1, 2])
def test_ctrl_c_keeps_finished_rows(tmp_path: Path, workers: int) -> None:
    (tmp_path / "batch/notes.txt").unlink()
    arguments = ["batch/b.sparse", "batch/ring.txt", "batch/pairs.wcnf", "solver=dmm", "solver.stall=null"]
    slow = ["solver.max_steps=50,10000000", "--output", "results.csv", f"workers={workers}"]
    process = launch(*arguments, *slow, folder=tmp_path, command="solve")
    assert process.stdout.readline().startswith("[1/6]  b  dmm solver.stall=null solver.max_steps=50  seed=0:")
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "memcomp-solve: interrupted. Finished rows are kept. Go on with: memcomp-solve batch/b.sparse" in err
    assert "Traceback" not in err
    assert rows(str(tmp_path / "results.csv"))[0]["problem"] == "b"
    assert not list(tmp_path.rglob("*.partial"))
    out, _ = launch(*arguments, "solver.max_steps=50", *slow[1:], folder=tmp_path, command="solve").communicate()
    assert re.match(r"[12] of 3 answers are in results.csv already.\n\[1/[12]\]", out)


PAGE = (Path(__file__).parents[2] / "docs/solve.md").read_text()
COMMANDS = [shlex.split(line, comments=True) for line in re.findall(r"^memcomp-solve .*$", PAGE, re.MULTILINE)]


def test_commands_of_the_page_run_in_their_order(memcomp_solve: Solve) -> None:
    (listed,) = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    Path("three.coo").write_text(listed)
    Path("batch/three.coo").write_text(f"# vartype=SPIN\n{listed}")
    assert len(COMMANDS) == 6
    outcomes = [memcomp_solve(*arguments) for _, *arguments in COMMANDS]
    assert [outcome.status for outcome in outcomes] == [0] * 6, [outcome.err for outcome in outcomes]
    assert re.search(r"energy +-7 .*assignment +101", outcomes[0].out, re.DOTALL)
    assert "4 of 16 answers" in outcomes[4].out
    assert rows()[-1]["problem"] == "three"
    assert Path("gap.png").exists()


def test_a_long_table_is_not_written_for_each_of_its_rows(
    memcomp_solve: Solve, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It took half of the time of a thousand rows. All are there at the end, and where it is interrupted."""
    write, written, seconds = solve_table.write_rows, list[int](), iter(range(10**6))

    def slow(table: Path, found: list[solve_table.Row]) -> None:
        for _ in range(10):
            next(seconds)
        written.append(len(found))
        write(table, found)

    monkeypatch.setattr(solve_table, "write_rows", slow)
    monkeypatch.setattr(batch, "time", SimpleNamespace(monotonic=lambda: next(seconds)))
    seeds = "seed=" + ",".join(map(str, range(60)))
    arguments = ["batch/ring.txt", "solver=alternating_descent", seeds, "--output", "results.csv"]
    assert memcomp_solve(*arguments).status == 0
    assert written[0] == 1
    assert written[-1] == len(rows()) == 60
    assert len(written) < 60 / batch.WAITS
    monkeypatch.setattr(batch, "_in_a_line", lambda *_: interrupt())
    stopped = memcomp_solve(*arguments[:-1], "other.csv")
    assert stopped.status == 130
    assert len(rows("other.csv")) == 1


def interrupt() -> str:
    raise KeyboardInterrupt
