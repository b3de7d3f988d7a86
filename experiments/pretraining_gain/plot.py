"""Test accuracy against pretraining iterations, from the table of a sweep.

python experiments/pretraining_gain/plot.py SWEEP_FOLDER FIGURE.png --control LABEL=RUN_FOLDER ...
"""

import argparse
import csv
import json
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from memcomp_lightning.cli.table import mean_and_error

STYLES = {
    "cd": {"label": "CD-1", "marker": "s", "markersize": 10, "fillstyle": "none"},
    "pcd": {"label": "PCD-1, 100 chains", "marker": "x"},
    "dmm_qubo": {"label": "ground state of the DMM", "marker": "o"},
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sweep", type=Path, help="folder of a multirun over sampler and pretrain.iterations")
    parser.add_argument("figure", type=Path, help="where to write the picture")
    parser.add_argument("--control", action="append", default=[], metavar="LABEL=RUN", help="a run as a line")
    arguments = parser.parse_args()
    curves: dict[str, list[tuple[int, float, float]]] = defaultdict(list)
    with (arguments.sweep / "table.csv").open() as file:
        for row in csv.DictReader(file):
            values = (float(row["test_accuracy_mean"]), float(row["test_accuracy_error"]))
            curves[row["sampler"]].append((int(row["pretrain.iterations"]), *values))
    figure, axes = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    for sampler, points in curves.items():
        iterations, means, errors = zip(*sorted(points), strict=True)
        axes.errorbar(iterations, means, errors, capsize=3, **STYLES.get(sampler, {"label": sampler}))
    for style, control in zip(("--", ":", "-."), arguments.control, strict=False):
        label, _, folder = control.partition("=")
        accuracies = json.loads((Path(folder) / "result.json").read_text())["test_accuracy"]
        axes.axhline(mean_and_error(accuracies)[0], color="0.3", linestyle=style, label=label)
    axes.set(
        xlabel="pretraining iterations a layer (full batch)",
        ylabel="test accuracy",
        ylim=(0, 1),
        title="Reduced MNIST, ten partitions, 100 fine-tuning passes (mean and standard error)",
    )
    axes.title.set_size(10)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(arguments.figure, dpi=110)


if __name__ == "__main__":
    main()
