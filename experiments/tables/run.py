"""Tables, sequences and their commands, beside known distributions and other methods.

python experiments/tables/run.py                       # all parts; the README has their times
python experiments/tables/run.py --only genotypes      # some of them
python experiments/tables/run.py --quick               # small cases, to try it; writes nothing
python experiments/tables/run.py --table               # prints the tables as they stand
"""

import argparse
import csv
import importlib
import resource
import time
from pathlib import Path
from typing import Any

import torch

PARTS = ["genotypes", "mixed", "alignments", "scale"]
"""Modules beside this file with ``measure(quick=...)``, which yields the rows of a table."""

HERE = Path(__file__).parent


def write(name: str, rows: list[dict[str, Any]]) -> None:
    """A table with all columns that a row has."""
    columns = list(dict.fromkeys(column for row in rows for column in row))
    with (HERE / f"{name}.csv").open("w", newline="") as file:
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


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--quick", action="store_true", help="small cases; no table is written")
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    for name in given.only:
        if not given.table:
            begin, spent, rows = time.perf_counter(), core_seconds(), list[dict[str, Any]]()
            for row in importlib.import_module(name).measure(quick=given.quick):
                rows.append(row)
                print(row, flush=True)
                if not given.quick:
                    write(name, rows)
            minutes, core_minutes = (time.perf_counter() - begin) / 60, (core_seconds() - spent) / 60
            print(f"{name}: {minutes:.1f} minutes, {core_minutes:.1f} core minutes")
        if not given.quick and (HERE / f"{name}.csv").exists():
            with (HERE / f"{name}.csv").open(newline="") as file:
                print(markdown(list(csv.DictReader(file))))


if __name__ == "__main__":
    main()
