"""Our solvers beside RC2 on weighted partial MAX-SAT; writes one table a family.

python experiments/hard_clauses/run.py                      # all families, about five minutes on one core
python experiments/hard_clauses/run.py potts scheduling
python experiments/hard_clauses/run.py table                # prints the tables as they stand
"""

import argparse
import csv
import multiprocessing
import random
import time
from pathlib import Path
from statistics import median
from typing import Any

from pysat.examples.rc2 import RC2Stratified
from structured import FAMILIES, Instance

from memcomp_lightning import rng
from memcomp_lightning.solvers import GibbsAnnealing, PenaltyLoop, Portfolio, TabuSearch
from memcomp_lightning.solvers.dmm import DmmSolver

RC2_SECONDS = 10.0
N_SEEDS = 3
SOLVERS = {
    "best": lambda n: Portfolio(),
    "annealing": lambda n: GibbsAnnealing(n_sweeps=1000),
    "DMM": lambda n: DmmSolver(),
    "tabu": lambda n: TabuSearch(),
    "best, 10 times": lambda n: Portfolio(n_restarts=84, effort=3.3),
    "DMM, 10 times": lambda n: DmmSolver(n_restarts=84, max_steps=10 * n, stall=None),
}


def proven(instance: Instance) -> tuple[int | None, float]:
    """The minimum by RC2 with the settings of its authors for weights, and its seconds; None beyond the limit."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    process = context.Process(target=_prove, args=(instance, theirs))
    process.start()
    found = ours.recv() if ours.poll(RC2_SECONDS + 5) else (None, RC2_SECONDS)
    process.terminate()
    process.join()
    return found if found[1] <= RC2_SECONDS else (None, RC2_SECONDS)


def _prove(instance: Instance, pipe: Any) -> None:
    formula, begin = instance.formula(), time.perf_counter()
    with RC2Stratified(formula, solver="g3", adapt=True, exhaust=True, minz=True) as solver:
        solver.compute()
        pipe.send((solver.cost, time.perf_counter() - begin))


def rows(family: Any) -> list[dict[str, Any]]:
    """What each solver finds of each instance of a family."""
    table = list[dict[str, Any]]()
    for size in FAMILIES[family]:
        instance = family(random.Random(0), *size)
        problem = instance.problem()
        name = f"{family.__name__} {'-'.join(map(str, size))}"
        minimum, seconds = proven(instance)
        row: dict[str, Any] = {"instance": name, "variables": instance.n, "hard": len(instance.hard)}
        row |= {"exactly k": len(instance.exactly), "soft": len(instance.soft)}
        row |= {"RC2": minimum, "RC2 seconds": f"{seconds:.2f}"}
        for label, make in SOLVERS.items():
            loop = PenaltyLoop(solver=make(instance.n))
            loop.minimise(problem, generator=rng.numpy_stream(0, "warm-up"))  # compiles
            costs, spent = list[float](), list[float]()
            for seed in range(N_SEEDS):
                found = loop.minimise(problem, generator=rng.numpy_stream(seed, "solver"))
                feasible = int(problem.n_broken(found.best[None])[0]) == 0
                costs.append(float(found.best_energy) if feasible else float("inf"))
                spent.append(found.wall_time_s)
            row |= {label: f"{median(costs):g}", f"{label} lowest": f"{min(costs):g}"}
            row[f"{label} seconds"] = f"{median(spent):.3f}"
        table.append(row)
        print(row, flush=True)
    return table


def markdown(table: list[dict[str, Any]]) -> str:
    """Median cost, less the lowest that anybody found or proved, and median seconds."""
    lines = []
    for row in table:
        costs = [float(row[f"{label} lowest"]) for label in SOLVERS]
        known = float(row["RC2"]) if row["RC2"] else min(costs)
        proof = f"{float(row['RC2 seconds']):.2g} s" if row["RC2"] else f"> {RC2_SECONDS:g} s"
        cells = [row["instance"], f"{row['variables']}", f"{known:g}", proof]
        for label in SOLVERS:
            above = float(row[label]) - known
            cells.append(f"{f'+{above:g}' if above else '='} in {float(row[f'{label} seconds']):.2g} s")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [family.__name__ for family in FAMILIES]
    parser.add_argument("families", nargs="*", help=f"of {', '.join(names)}, or table: run nothing; default: all")
    wanted = parser.parse_args().families
    unknown = sorted(set(wanted) - {*names, "table"})
    if unknown:
        parser.error(f"{', '.join(unknown)}: expected some of {', '.join(names)}, or table")
    for family in FAMILIES:
        if wanted and family.__name__ not in wanted:
            continue
        table = rows(family)
        with Path(__file__).with_name(f"{family.__name__}.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(table[0]))
            writer.writeheader()
            writer.writerows(table)
    titles = ["instance", "variables", "lowest known", "RC2", *SOLVERS]
    print(f"| {' | '.join(titles)} |\n|{' --- |' * len(titles)}")
    for path in sorted(Path(__file__).parent.glob("*.csv")):
        with path.open(newline="") as file:
            print(markdown(list(csv.DictReader(file))))


if __name__ == "__main__":
    main()
