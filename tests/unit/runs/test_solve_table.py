"""The table of many answers: gaps are exact, files come back as they were, curves follow solutions."""

import json

import pytest

from memcomp_lightning.errors import UserError
from memcomp_lightning.runs import solve_table
from memcomp_lightning.runs.solve_table import COLUMNS


def row(file="a.coo", solver="best", value="-10", direction="minimise", **cells):
    blank = dict.fromkeys(COLUMNS, "")
    known = {
        "problem": file[0],
        "file": file,
        "solver": solver,
        "seed": "0",
        "value": value,
        "direction": direction,
    }
    return blank | known | {"wall_time_s": "0.5", "status": "STEP_BUDGET"} | cells


@pytest.mark.parametrize(
    ("direction", "value", "known", "gap"),
    [
        ("minimise", "-10", "-10", "0"),
        ("minimise", "-9", "-10", "0.1"),
        ("minimise", "-12", "-10", "-0.2"),
        ("maximise", "9", "10", "0.1"),
        ("maximise", "12.5", "10", "-0.25"),
        ("minimise", "3", "0", "3"),
        ("minimise", "100000000000000000001", "100000000000000000000", "1e-20"),
        ("minimise", "0.3", "0.30", "0"),
    ],
)
def test_gap_is_how_much_worse_over_the_size_of_what_is_known(direction, value, known, gap):
    (found,) = solve_table.with_gaps([row(value=value, direction=direction)], {"a.coo": known})
    assert (found["gap"], found["best_known"]) == (gap, known)


def test_the_best_of_the_table_stands_in_for_what_is_not_known():
    rows = [
        row(value="-8"),
        row(solver="tabu"),
        row(solver="dmm", value="-20", hard_unsatisfied="1"),
        row(file="b.txt", value="3", direction="maximise"),
        row(file="b.txt", solver="tabu", value="4", direction="maximise"),
        row(file="c.txt", value="", error="no such file"),
    ]
    gaps = [found["gap"] for found in solve_table.with_gaps(rows, {})]
    assert gaps == ["0.2", "0", "", "0.25", "0", ""], "an answer that breaks a hard clause is none"


def test_summary_counts():
    rows = [
        row(status="OPTIMAL"),
        row(file="b.coo", value="-9"),
        row(file="c.coo", value="-11"),
        row(file="d.coo", hard_unsatisfied="2"),
        row(file="e.coo", error="too large"),
        row(solver="tabu", settings="solver.n_restarts=3", wall_time_s="1.5"),
    ]
    known = dict.fromkeys(("a.coo", "b.coo", "c.coo", "d.coo"), "-10")
    head, _, best, tabu, against = solve_table.summary(solve_table.with_gaps(rows, known)).splitlines()
    names = [name.strip() for name in head.split("  ") if name.strip()]
    assert names[4:6] == ["at best known", "better"]
    assert best.split() == ["best", "4", "0", "%", "10", "%", "1", "1", "1", "1", "1", "0.50", "s"]
    assert tabu.split()[:4] == ["tabu", "solver.n_restarts=3", "1", "0"]
    assert against == "Gaps are to best known values."
    two = solve_table.with_gaps(rows[:2], {"a.coo": "-10"})
    assert solve_table.summary(two).endswith("best known values, 1 of them to the best of this table.")


def test_rows_are_read_as_they_were_written(tmp_path):
    rows = [row(error='a "quoted", text\nof two lines'), row(file="ü.coo")]
    solve_table.write_rows(tmp_path / "t.csv", rows)
    assert solve_table.read_rows(tmp_path / "t.csv") == rows
    assert solve_table.read_rows(tmp_path / "none.csv") == []


@pytest.mark.parametrize("text", ["", "name,value\na,1\n", ",".join(COLUMNS) + "\nonly,three,cells\n"])
def test_other_files_are_no_tables(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(UserError, match=r"t.csv is no table of this version's memcomp-solve"):
        solve_table.read_rows(tmp_path / "t.csv")


def test_curves_end_at_the_answer_and_begin_where_the_solution_says(tmp_path):
    (tmp_path / "cut.json").write_text(json.dumps({"curve": [[0.1, -5], [0.2, -8]]}))
    rows = [
        row(file="g.txt", value="8", direction="maximise", solution="cut.json"),
        row(file="a.coo", solution="lost.json"),
        row(file="a.coo", error="too large"),
    ]
    curves = solve_table.curves(rows, {"g.txt": "10"}, tmp_path)
    assert curves == {"best": [[(0.1, 0.5), (0.2, 0.2), (0.5, 0.2)], [(0.5, 0.0)]]}


@pytest.mark.parametrize(("name", "cell"), [("value", "x"), ("value", "1e999999999"), ("wall_time_s", "")])
def test_a_table_whose_numbers_are_none_is_refused_by_row(tmp_path, name, cell):
    solve_table.write_rows(tmp_path / "t.csv", [row(), row(seed="1") | {name: cell}])
    with pytest.raises(UserError, match=f"row 2: {name} is '{cell}', expected a number"):
        solve_table.read_rows(tmp_path / "t.csv")


def test_a_best_known_value_of_a_billion_digits(tmp_path):
    (tmp_path / "best.csv").write_text("name,value\na.coo,1e999999999\n")
    with pytest.raises(UserError, match="line 2"):
        solve_table.read_best_known(tmp_path / "best.csv")
