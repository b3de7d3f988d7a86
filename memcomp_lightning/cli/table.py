"""Results as short tables."""

import math
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def mean_and_error(values: Sequence[float]) -> tuple[float, float | None]:
    """Mean and standard error sigma / sqrt(n); the error of a single value is None.

    >>> mean_and_error([1.0, 3.0])
    (2.0, 1.0)
    """
    n = len(values)
    mean = sum(values) / n
    if n == 1:
        return mean, None
    return mean, math.sqrt(sum((value - mean) ** 2 for value in values) / (n - 1) / n)


def with_error(values: Sequence[float], digits: int = 4) -> str:
    """Mean and standard error as text."""
    mean, error = mean_and_error(values)
    return f"{mean:.{digits}f}" if error is None else f"{mean:.{digits}f} ± {error:.{digits}f}"


def aligned(rows: Sequence[Sequence[str]]) -> str:
    """Rows as columns: the first one is the header, numbers to the right."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    ]
    lines.insert(1, "  ".join("─" * width for width in widths))
    return "\n".join(lines)


def run_table(result: dict[str, Any]) -> str:
    """Energy gap, test accuracy and wall time of each stage of one run, and what held-out images chose for it."""
    rows = [["stage", "iterations", "energy gap (data - model)", "test accuracy", "wall time"]]
    for name, record in result["stages"].items():
        gaps = record.get("energy_gap", [])
        for trained, gap in zip(record.get("trained", []), gaps, strict=False):
            rows.append([f"{name} {trained}", str(record["iterations"]), with_error(gap), "", ""])
        if not gaps:
            rows.append([name, str(record["iterations"]), "", with_error(result["test_accuracy"]), ""])
        rows[-1][-1] = f"{record['wall_time_s']:.1f} s"
    choice = result.get("choice")
    chosen = f"\nChosen on held-out training images: {choice['setting']} = {choice['value']:g}" if choice else ""
    judged = result.get("validation_accuracy")
    held_out = f"\nAccuracy on held-out training images: {with_error(judged)}" if judged else ""
    return aligned(rows) + chosen + held_out


def closing_lines(folder: Path) -> str:
    """Where the run is and how to look at it; the command works in a virtual environment that is not active."""
    place = f"\nRun folder:   {folder}"
    if not any(folder.rglob("events.out.tfevents.*")):
        return place
    beside_python = Path(sys.executable).parent / "tensorboard"
    command = "tensorboard" if shutil.which("tensorboard") else short_path(beside_python)
    return f"{place}\nTensorBoard:  {command} --logdir '{folder}'"


def short_path(path: Path) -> Path:
    """The path as a person in the current folder would type it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
