"""Test accuracy and time of every sampler with the default settings, over seeds and splits of the digits.

python experiments/defaults/run.py            # the table; rows that results.csv has are not run again
"""

import argparse
import csv
import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).parent
RUNS = {
    "cd": ["sampler=cd"],
    "pcd": ["sampler=pcd"],
    "parallel_tempering": ["sampler=parallel_tempering"],
    "exact, 12 and 32 hidden units": ["sampler=exact", "model.hidden_sizes=[12,32]"],
    "dmm_qubo": ["sampler=dmm_qubo"],
    "dmm_time_average": ["sampler=dmm_time_average"],
    "ground_state": ["sampler=ground_state"],
    "mode_assisted_cd": ["sampler=mode_assisted_cd"],
    "mode_assisted_pcd": ["sampler=mode_assisted_pcd"],
    "quench": ["sampler=quench"],
    "annealer (simulated annealing of dimod)": ["sampler=annealer"],
    "cd, preset=paper": ["sampler=cd", "preset=paper"],
}
COLUMNS = ("run", "seed", "test_accuracy", "log_likelihood_layer1", "logistic_regression", "seconds")


def run(overrides: list[str], seed: int) -> dict[str, float]:
    """Accuracy, held-out log-likelihood of the first layer, and seconds of a whole command."""
    with tempfile.TemporaryDirectory() as folder:
        command = [
            *(sys.executable, "-m", "memcomp_lightning.cli.train", *overrides, f"seed={seed}"),
            *(f"data.source.split_seed={seed}", f"hydra.run.dir={folder}/run"),
        ]
        begin = time.perf_counter()
        subprocess.run(command, check=True, capture_output=True)
        seconds = time.perf_counter() - begin
        result = json.loads((Path(folder) / "run" / "result.json").read_text())
    values = [value for value in result["stages"]["pretrain"]["log_likelihood"] if value["layer"] == 0]
    return {
        "test_accuracy": result["test_accuracy"][0],
        "log_likelihood_layer1": values[-1]["heldout"][0],
        "logistic_regression": result["context"]["logistic_regression"]["test_accuracy"],
        "seconds": seconds,
    }


def main() -> None:
    """Run what results.csv lacks, then print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--results", type=Path, default=HERE / "results.csv")
    arguments = parser.parse_args()
    rows = list(csv.DictReader(arguments.results.open())) if arguments.results.exists() else []
    for seed in range(arguments.seeds):
        for name, overrides in RUNS.items():
            if not any(row["run"] == name and int(row["seed"]) == seed for row in rows):
                rows.append({"run": name, "seed": str(seed), **run(overrides, seed)})
                print(rows[-1], flush=True)
                with arguments.results.open("w", newline="") as file:
                    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                    writer.writeheader()
                    writer.writerows(rows)
    print(table(rows))


def table(rows: list[dict[str, str]]) -> str:
    """Means and standard errors over seeds, as Markdown."""
    lines = [
        "| sampler | test accuracy | log-likelihood of layer 1, held-out | seconds, median (longest) |",
        "| --- | --- | --- | --- |",
    ]
    for name in RUNS:
        own = [row for row in rows if row["run"] == name]
        if own:
            accuracy, nats, seconds = (
                [float(row[key]) for row in own] for key in ("test_accuracy", "log_likelihood_layer1", "seconds")
            )
            lines.append(
                f"| {name} | {with_error(accuracy, 3)} | {with_error(nats, 2)} "
                f"| {statistics.median(seconds):.0f} ({max(seconds):.0f}) |"
            )
    regression = {row["seed"]: float(row["logistic_regression"]) for row in rows}
    lines.append(f"| logistic regression on the inputs | {with_error(list(regression.values()), 3)} | | |")
    return "\n".join(lines)


def with_error(values: list[float], digits: int) -> str:
    """Mean and standard error."""
    error = statistics.stdev(values) / len(values) ** 0.5 if len(values) > 1 else 0.0
    return f"{statistics.mean(values):.{digits}f} ± {error:.{digits}f}"


if __name__ == "__main__":
    main()
