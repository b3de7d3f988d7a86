"""Models of units of every kind beside known couplings, known densities, known minima, and loops by hand.

python experiments/units/run.py                     # all parts; the README has their times
python experiments/units/run.py --only speed ising  # some of them
python experiments/units/run.py --quick             # small cases in a minute, to try it; writes nothing
python experiments/units/run.py --table             # prints the tables as they stand
"""

import argparse
import csv
import importlib
import time
from pathlib import Path
from typing import Any

PARTS = ["speed", "mixture", "ising", "ground_states", "sequences"]
"""Modules beside this file with ``measure(quick=...)``, which yields the rows of a table,
or with commands of their own."""

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


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--quick", action="store_true", help="small cases; no table is written")
    parser.add_argument("--table", action="store_true", help="run nothing")
    given = parser.parse_args(arguments)
    for name in given.only:
        if not (HERE / f"{name}.py").exists():
            print(f"{name}: not here yet")
            continue
        if not given.table:
            begin, spent = time.perf_counter(), time.process_time()
            rows = list[dict[str, Any]]()
            module = importlib.import_module(name)
            if not hasattr(module, "measure"):
                print(f"{name}: {module.__doc__}")
                continue
            for row in module.measure(quick=given.quick):
                rows.append(row)
                print(row, flush=True)
                if not given.quick:
                    write(name, rows)
            minutes, core_hours = (time.perf_counter() - begin) / 60, (time.process_time() - spent) / 3600
            print(f"{name}: {minutes:.1f} minutes, {core_hours:.2f} core hours")
        if not given.quick and (HERE / f"{name}.csv").exists():
            with (HERE / f"{name}.csv").open(newline="") as file:
                print(markdown(list(csv.DictReader(file))))


if __name__ == "__main__":
    main()
