"""The command line of an experiment in parts: modules beside its ``run.py``, each with a table of its name."""

import argparse
import csv
import importlib
import resource
import time
from pathlib import Path
from typing import Any


def main(description: str | None, parts: list[str], folder: Path) -> None:
    """Run parts, all by default; each row is printed, and its table written, as it comes.

    Args:
        description: For ``--help``.
        parts: Modules with ``measure(quick=...)``, which yields rows of a table, or with commands of their own.
        folder: Theirs, where the tables go.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=parts, default=parts, metavar="PART", help=", ".join(parts))
    parser.add_argument("--quick", action="store_true", help="small cases; no table is written")
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args()
    for name in given.only:
        table = folder / f"{name}.csv"
        if not given.table:
            begin, spent, rows = time.perf_counter(), core_seconds(), list[dict[str, Any]]()
            module = importlib.import_module(name)
            if not hasattr(module, "measure"):
                print(f"{name}: {module.__doc__}")
                continue
            for row in module.measure(quick=given.quick):
                rows.append(row)
                print(row, flush=True)
                if not given.quick:
                    write(table, rows)
            minutes, core_minutes = (time.perf_counter() - begin) / 60, (core_seconds() - spent) / 60
            print(f"{name}: {minutes:.1f} minutes, {core_minutes:.1f} core minutes")
        if not given.quick and table.exists():
            with table.open(newline="") as file:
                print(markdown(list(csv.DictReader(file))))


def write(path: Path, rows: list[dict[str, Any]]) -> None:
    """A table with all columns that a row has."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def markdown(rows: list[dict[str, Any]]) -> str:
    """Rows as a table of a page."""
    lines = [f"| {' | '.join(rows[0])} |", f"|{' --- |' * len(rows[0])}"]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row.values()))} |" for row in rows)])


def core_seconds() -> float:
    """Of this process and of those that it has started."""
    own, children = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime
