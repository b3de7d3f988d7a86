"""Answers to many problems as one table: a row for each problem, solver and seed, with gaps to what is known."""

import csv
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path

from memcomp_lightning.errors import UserError
from memcomp_lightning.files import as_csv, inside, read_json, write_text
from memcomp_lightning.problems.files.numbers import fits
from memcomp_lightning.runs import table

COLUMNS = (
    *("problem", "file", "solver", "settings", "seed", "variables", "couplings", "clauses", "hard_clauses"),
    *("objective", "direction", "value", "hard_unsatisfied", "energy", "status", "restarts", "reached"),
    *("wall_time_s", "best_known", "gap", "solution", "error", "fingerprint"),
)
"""Of the CSV file. ``file`` and ``solution`` are meant from its folder."""

Curve = list[tuple[float, float]]
"""Seconds and gap of an answer, on the way and at its end."""

Row = dict[str, str]
"""The cells of one answer by column, as text; an ``error`` in place of an answer where a problem was refused."""


def key(row: Mapping[str, str]) -> tuple[str, ...]:
    """What a table has one row of."""
    return tuple(row[column] for column in ("file", "solver", "settings", "seed"))


def read_rows(path: Path) -> list[Row]:
    """The rows of a table that was begun, none where there is none.

    Raises:
        UserError: The file is no such table.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            header, *lines = list(csv.reader(file)) or [[]]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, csv.Error) as error:
        raise UserError(f"{path} cannot be read ({error}): choose another file with --output FILE.") from error
    if tuple(header) != COLUMNS or any(len(cells) != len(COLUMNS) for cells in lines):
        raise UserError(f"{path} is no table of this version's memcomp-solve: choose another with --output FILE.")
    rows = [dict(zip(COLUMNS, cells, strict=True)) for cells in lines]
    for number, row in enumerate(rows, start=1):
        for name in ("value", "wall_time_s") if not row["error"] else ():
            if not fits(row[name]):
                found = f"{path}, row {number}: {name} is {row[name][:40]!r}, expected a number"
                raise UserError(f"{found}: choose another file with --output FILE.")
    return rows


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write the table, whole or not at all."""
    write_text(path, as_csv([COLUMNS, *([row[column] for column in COLUMNS] for row in rows)]))


def read_best_known(path: Path) -> dict[str, str]:
    """Best known values of problems by name, from a CSV file that begins with the line ``name,value``.

    Raises:
        UserError: The file cannot be read; naming the line, what was found and what is expected.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [[cell.strip() for cell in line] for line in csv.reader(file)]
    except (OSError, ValueError, csv.Error) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"best_known={path} cannot be read ({reason}).") from error
    if not lines or lines[0] != ["name", "value"]:
        raise UserError(f"best_known={path}: expected name,value in its first line, then a problem a line.")
    known: dict[str, str] = {}
    for number, line in enumerate(lines[1:], start=2):
        if line and (len(line) != 2 or not line[0] or not fits(line[1])):
            found = f"found {','.join(line)!r}, expected a problem's name and a number"
            raise UserError(f"best_known={path}, line {number}: {found}.")
        if line and line[0] in known:
            raise UserError(f"best_known={path}, line {number}: {line[0]} stands there a second time.")
        if line:
            known[line[0]] = line[1]
    return known


# ------------------------------------------------------------------------------------------------------------ gaps


def references(rows: Iterable[Row], known: Mapping[str, str]) -> dict[str, Fraction]:
    """What the rows of each file are compared with: the value that is known, else the best among the rows.

    ``known`` has the values by ``file``.
    """
    compared = {file: Fraction(value) for file, value in known.items()}
    for row in filter(is_answer, rows):
        better = max if row["direction"] == "maximise" else min
        if row["file"] not in known:
            compared[row["file"]] = better(
                compared.get(row["file"], Fraction(row["value"])), Fraction(row["value"])
            )
    return compared


def with_gaps(rows: Sequence[Row], known: Mapping[str, str]) -> list[Row]:
    """The rows with gaps to their :func:`references`, and the values among these that are known."""
    compared = references(rows, known)

    def cell(row: Row) -> str:
        return f"{gap(row, Fraction(row['value']), compared[row['file']]):.6g}" if is_answer(row) else ""

    return [row | {"best_known": known.get(row["file"], ""), "gap": cell(row)} for row in rows]


def curves(rows: Sequence[Row], known: Mapping[str, str], folder: Path) -> dict[str, list[Curve]]:
    """Seconds and gap of the answers by solver, on the way where their solutions in ``folder`` tell it."""
    compared = references(rows, known)
    found: dict[str, list[Curve]] = {}
    for row, name in zip(rows, labels(rows), strict=True):
        if not is_answer(row):
            continue
        try:
            told = read_json(inside(folder, row["solution"])).get("curve", [])
        except (OSError, ValueError):
            told = []
        sign, reference = -1 if row["direction"] == "maximise" else 1, compared[row["file"]]
        on_the_way = [(seconds, gap(row, sign * Fraction(energy), reference)) for seconds, energy in told]
        end = float(row["wall_time_s"]), gap(row, Fraction(row["value"]), reference)
        found.setdefault(name, []).append([*on_the_way, end])
    return found


def is_answer(row: Row) -> bool:
    """Whether the row holds a solution: the problem was solved, and no hard clause is broken."""
    return not row["error"] and row["hard_unsatisfied"] in ("", "0")


def gap(row: Row, value: Fraction, reference: Fraction) -> float:
    """How much worse a value is, over the size of the reference unless that is 0; negative where it is better."""
    worse = reference - value if row["direction"] == "maximise" else value - reference
    return float(worse / (abs(reference) or 1))


# ------------------------------------------------------------------------------------------------------ for people


def labels(rows: Sequence[Row]) -> list[str]:
    """The solver of each row, with its settings where these are not the same in all rows."""
    differ = len({row["settings"] for row in rows}) > 1
    return [f"{row['solver']} {row['settings']}".rstrip() if differ else row["solver"] for row in rows]


def summary(rows: Sequence[Row]) -> str:
    """The solvers side by side, over all problems and seeds."""
    known = any(row["best_known"] for row in rows)
    title = ["solver", "answers", "mean gap", "largest gap", "at best known" if known else "at best", "better"]
    screen = [[*title, "proven", "hard clauses broken", "refused", "mean time"]]
    names = labels(rows)
    for name in dict.fromkeys(names):
        own = [row for row, of in zip(rows, names, strict=True) if of == name]
        solved = [row for row in own if not row["error"]]
        gaps = [float(row["gap"]) for row in own if is_answer(row)]
        proven = sum(row["status"] == "OPTIMAL" for row in solved)
        counts = [sum(g == 0 for g in gaps), sum(g < 0 for g in gaps), proven]
        counts += [len(solved) - len(gaps), len(own) - len(solved)]
        seconds = [float(row["wall_time_s"]) for row in solved]
        screen.append(
            [
                *(name, str(len(solved))),
                *((_percent(sum(gaps) / len(gaps)), _percent(max(gaps))) if gaps else ("", "")),
                str(counts[0]),
                *(str(count or "") for count in counts[1:]),
                f"{sum(seconds) / len(seconds):.2f} s" if seconds else "",
            ]
        )
    others = sum(is_answer(row) and not row["best_known"] for row in rows)
    against = "the best of this table" if not known else "best known values"
    rest = f", {others} of them to the best of this table" if known and others else ""
    return f"{table.for_screen(screen)}\nGaps are to {against}{rest}."


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %"
