"""Which default serves tables that it was not chosen on: recipes on all tables, by held-out rows alone.

    python experiments/density/defaults.py           # trains what defaults.csv lacks; half an hour of one core
    python experiments/density/defaults.py --table   # what the numbers say

Each recipe trains an RBM on each table as `experiment=density` does, at a rate that falls, with one seed, and is
measured on the validation file along the way. A recipe's regret on a table is by how much its log-likelihood stays
below that of the best recipe there. For each table the recipe with the least mean regret on the *other* tables is
chosen, and its regret on that table reported: what a default costs a user who has a table of his own. Test files
are not read. Twice: with the weights of the best measurement (`data=table` keeps these), and with the last ones
(`MemcompRBM` keeps these).
"""

import argparse
import csv
from itertools import product
from pathlib import Path

import numpy as np
from hydra import compose

from memcomp_lightning.configuration.composition import composing
from memcomp_lightning.configuration.densities import files_of, trial_of
from memcomp_lightning.configuration.values import filled
from memcomp_lightning.studies.density import Density
from memcomp_lightning.studies.density.peers import read_rows
from memcomp_lightning.studies.density.trial import independent_bits

RESULTS = Path(__file__).with_name("defaults.csv")
COLUMNS = ["table", "sampler", "rate", "hidden", "updates", "best", "last", "independent", "seconds"]
OVERRIDES = ["experiment=density", "density.patience=1000", "density.points=9"]
WITHOUT_PENALTY = {"l2": 0.0}
AXES = {"rate": [0.05, 0.1, 0.2], "hidden": [64, 128], "updates": [10000]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", action="store_true", help="train nothing")
    parser.add_argument("--samplers", nargs="+", default=["pcd", "pt", "mode_cd"], help="models of conf/density")
    parser.add_argument("--tables", nargs="+", help="all by default")
    given = parser.parse_args()
    if not given.table:
        with composing():
            train(given.samplers, given.tables)
    print(report(rows()))


def train(samplers: list[str], tables: list[str] | None) -> None:
    """Write a row for each recipe and table that has none."""
    density = filled(Density, compose("config", OVERRIDES).density, "density")
    done = {(row["table"], row["sampler"], row["rate"], row["hidden"], row["updates"]) for row in rows()}
    for table, sampler, *values in product(tables or density.tables, samplers, *AXES.values()):
        key = (table, sampler, *map(str, values))
        if key in done:
            continue
        setting = {**WITHOUT_PENALTY, **dict(zip(AXES, values, strict=True))}
        trial = trial_of(density, [], table, files_of(density, table), sampler, setting, choosing=True)
        (record,) = trial.run(lambda what, n: None)
        valid = np.nan_to_num(record.measured("valid")[:, 0], nan=-np.inf)
        train, held_out, _ = map(read_rows, files_of(density, table))
        start = float(independent_bits(train, held_out))
        numbers = [f"{valid.max():.4f}", f"{valid[-1]:.4f}", f"{start:.4f}", f"{record.seconds[-1]:.2f}"]
        add([*key, *numbers])
        print(*key, *numbers, flush=True)


def add(row: list[str]) -> None:
    new = not RESULTS.exists()
    with RESULTS.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([COLUMNS, row] if new else [row])


def rows() -> list[dict[str, str]]:
    if not RESULTS.exists():
        return []
    with RESULTS.open(newline="") as file:
        return list(csv.DictReader(file))


def report(found: list[dict[str, str]]) -> str:
    """What leaving a table out chooses for it, and what that costs there."""
    lines = []
    for column in ("best", "last"):
        recipes, tables, values = matrix(found, column)
        if not tables:
            return "nothing is measured on all recipes yet"
        regret = values.max(0) - values
        lines += [
            f"\n{column} weights",
            "| table | chosen on the others | regret there | of the best recipe |",
            "|---|---|---|---|",
        ]
        for j, table in enumerate(tables):
            others = np.delete(regret, j, axis=1).mean(1) if len(tables) > 1 else regret[:, 0]
            i = int(others.argmin())
            best = recipes[int(regret[:, j].argmin())]
            lines.append(f"| {table} | {named(recipes[i])} | {regret[i, j]:.2f} | {named(best)} |")
        order = np.argsort(regret.mean(1))[:5]
        lines += ["", "| the five of least mean regret | mean | worst |", "|---|---|---|"]
        lines += [f"| {named(recipes[i])} | {regret[i].mean():.2f} | {regret[i].max():.2f} |" for i in order]
    return "\n".join(lines)


def named(recipe: tuple[str, ...]) -> str:
    sampler, rate, hidden, updates = recipe
    return f"{sampler}, rate {rate}, {hidden} hidden, {updates} updates"


def matrix(found: list[dict[str, str]], column: str) -> tuple[list[tuple[str, ...]], list[str], np.ndarray]:
    """Recipes, the tables that have all of them, and log-likelihoods, (recipes, tables)."""
    by_key = {(r["table"], (r["sampler"], r["rate"], r["hidden"], r["updates"])): float(r[column]) for r in found}
    recipes = sorted({recipe for _, recipe in by_key})
    tables = [t for t in dict.fromkeys(t for t, _ in by_key) if all((t, recipe) in by_key for recipe in recipes)]
    values = np.array([[by_key[t, recipe] for t in tables] for recipe in recipes]).reshape(
        len(recipes), len(tables)
    )
    return recipes, tables, values


if __name__ == "__main__":
    main()
