"""The DMM beside its opponents, family by family: one command, one table, one verdict a target.

    python experiments/solver_benchmark/run.py                    # hours on one core; stop and start it at will
    python experiments/solver_benchmark/run.py --short            # about an hour: fewer reads
    python experiments/solver_benchmark/run.py --quick            # minutes: does everything run?
    python experiments/solver_benchmark/run.py --families "planted.*" "G-set"

Every measurement is appended to ``OUT/measurements.jsonl`` as soon as it exists, and is not repeated unless its
settings, its instance or the solver's version change.
"""

import os

for _name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import datetime  # noqa: E402
import importlib.metadata  # noqa: E402
import json  # noqa: E402
import logging  # noqa: E402
import platform  # noqa: E402
import re  # noqa: E402
import sys  # noqa: E402
from collections.abc import Iterator  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from pathlib import Path  # noqa: E402

import numba  # noqa: E402
import plots  # noqa: E402
import report  # noqa: E402
import sweep  # noqa: E402
import targets  # noqa: E402
import torch  # noqa: E402
import verdicts  # noqa: E402
from families import Family, families  # noqa: E402
from side_by_side import SOLVERS  # noqa: E402
from sweep import Effort, Row, Store  # noqa: E402
from tqdm import tqdm  # noqa: E402

HERE = Path(__file__).parent
QUICK = (
    r"(plain|mean-cancelled), std 1, 32x32|plain, std 1, 100x100|planted loops, (40x40|60x60|90x90)",
    r".*MAX-[23]-SAT.* n=100|trained on .*, CD-1, 3,600.*|Beasley",
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Plan:
    """How much is measured.

    Attributes:
        tuning: Effort of each setting of the sweep.
        reported: Effort of each finalist.
        limit: Most instances of a family, for tuning and for reporting each.
        proof_seconds: About the longest attempt to prove a minimum.
        n_problems: Problems of the throughput test.
        couplings: Sizes of the linear-cost test.
    """

    tuning: Effort
    reported: Effort
    limit: int | None
    proof_seconds: float
    n_problems: int
    couplings: tuple[int, ...]


FULL_PLAN = Plan(
    tuning=Effort(0.5, 1000),
    reported=Effort(2.0, 2000),
    limit=None,
    proof_seconds=30.0,
    n_problems=500,
    couplings=targets.COUPLINGS,
)
SHORT_PLAN = Plan(
    tuning=Effort(0.05, 300),
    reported=Effort(0.25, 1000),
    limit=None,
    proof_seconds=2.0,
    n_problems=500,
    couplings=targets.COUPLINGS,
)
QUICK_PLAN = Plan(
    tuning=Effort(0.02, 50),
    reported=Effort(0.1, 200),
    limit=1,
    proof_seconds=2.0,
    n_problems=5,
    couplings=targets.COUPLINGS[:3],
)


def machine() -> Row:
    """Where and with what this was run."""
    cpuinfo = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*:\s*(.*)", cpuinfo.read_text()) if cpuinfo.exists() else None
    packages = ("memcomp-lightning", *sweep.PACKAGES)
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": " ".join(["python", *sys.argv]),
        "cpu": model.group(1) if model else platform.processor(),
        "cores": os.cpu_count(),
        "threads": 1,
        "load average at the end": os.getloadavg()[2],
        "python": platform.python_version(),
        "DMM source": sweep.version("DMM"),
        **{package: importlib.metadata.version(package) for package in packages},
    }


def measure_all(store: Store, chosen: list[Family], everything: list[Family], plan: Plan) -> list[report.Outcome]:
    """Tune, then report, with a progress bar; what the file holds already passes in no time."""
    names = {other.name for family in chosen for other in sweep.tuned_for(family, everything)}
    to_tune = [family for family in everything if family.name in names]
    n_settings = sum(len(kind.budgets) * len(kind.variants) for kind in SOLVERS)
    n_tuning = {family.name: _count(family.n_tuning, plan.limit) * n_settings for family in to_tune}
    n_report = {f.name: _count(f.n_report, plan.limit) * (1 + sweep.N_FINALISTS * len(SOLVERS)) for f in chosen}
    tuned: dict[str, list[Row]] = {}
    outcomes = []
    with tqdm(total=sum(n_tuning.values()) + sum(n_report.values()), unit="run", smoothing=0.02) as bar:

        def watched(family: Family, what: str, rows: Iterator[Row], n_most: int) -> list[Row]:
            seen = []
            for row in rows:
                seen.append(row)
                bar.set_description(f"{what} {family.name}: {row.get('solver', 'proof')}"[:70], refresh=False)
                bar.update()
            bar.update(n_most - len(seen))  # budgets too large for the time, fewer finalists
            return seen

        for family in to_tune:
            rows = sweep.tune(store, family, plan.tuning, plan.limit)
            tuned[family.name] = watched(family, "tuning", rows, n_tuning[family.name])
        for family in chosen:
            settings = {kind: sweep.finalists(store, tuned, family, everything, kind) for kind in SOLVERS}
            rows = sweep.report(store, family, settings, plan.reported, plan.limit, plan.proof_seconds)
            found = watched(family, "reporting", rows, n_report[family.name])
            outcomes.append(report.outcome(store, family, settings, found))
    return outcomes


def _count(n: int, limit: int | None) -> int:
    return n if limit is None else min(n, limit)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", nargs="+", help="regular expressions of whole names; default: all")
    parser.add_argument("--list", action="store_true", help="print the names of the families and stop")
    parser.add_argument("--short", action="store_true", help="fewer reads and shorter proofs")
    parser.add_argument("--quick", action="store_true", help="few instances, little time: a test of the benchmark")
    parser.add_argument("--out", type=Path, default=None, help="folder of the results")
    parser.add_argument("--cache", type=Path, default=HERE / "cache", help="folder of trained weights")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    logging.getLogger("simulated_bifurcation_optimizer").setLevel(logging.ERROR)
    everything = families(arguments.cache)
    patterns = arguments.families or (QUICK if arguments.quick else [".*"])
    chosen = [family for family in everything if any(re.fullmatch(pattern, family.name) for pattern in patterns)]
    if arguments.list:
        print(*(family.name for family in everything), sep="\n")
        return
    if not chosen:
        parser.error(f"no family is called like {' or '.join(patterns)}; --list prints their names")
    plan = QUICK_PLAN if arguments.quick else SHORT_PLAN if arguments.short else FULL_PLAN
    out = arguments.out or HERE / (
        "results_quick" if arguments.quick else "results_short" if arguments.short else "results"
    )
    store = Store(out / "measurements.jsonl")
    outcomes = measure_all(store, chosen, everything, plan)
    calls = [
        row for family in tqdm(chosen, "calls", unit="family") for row in targets.calls(store, family, plan.limit)
    ]
    throughput = targets.throughput(store, plan.n_problems)
    costs = [targets.linear_cost(store, n) for n in tqdm(plan.couplings, "linear cost", unit="size")]
    table = [record for outcome in outcomes for record in report.records(outcome)]
    answers = verdicts.verdicts(outcomes, table, calls, throughput, costs)
    (out / "machine.json").write_text(json.dumps(machine(), indent=1) + "\n")
    report.write_csv(out / "table.csv", table)
    (out / "table.md").write_text(report.markdown(table))
    (out / "verdicts.md").write_text(verdicts.markdown(answers))
    plots.time_to_solution(out / "time_to_solution.png", table)
    plots.gap_against_time(out / "gap_against_time.png", outcomes)
    plots.planted_scaling(out / "planted_scaling.png", outcomes)
    plots.linear_cost(out / "linear_cost.png", costs)
    print(report.markdown(table), verdicts.markdown(answers), sep="\n")
    disturbed = sum(row.get("busy", 1.0) < 0.9 for row in store.rows.values())
    if disturbed:
        print(f"{disturbed} of {len(store.rows)} measurements shared their core with others.", file=sys.stderr)
    for row in store.rows.values():
        if "error" in row:
            print(f"not measured: {row['solver']} on {row['instance']}: {row['error']}", file=sys.stderr)


if __name__ == "__main__":
    main()
