"""Results as short tables."""

import math
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

LIKELIHOOD_TITLE = "log-likelihood (held-out)"


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


def aligned(rows: Sequence[Sequence[str]], *, most: int | None = None) -> str:
    """The rows as text in columns that are aligned to the right; the first row is the header.

    A header that makes lines longer than ``most`` characters has its words below each other.
    """
    head, n = [[cell] for cell in rows[0]], len(rows[0])
    if most is not None and sum(max(len(row[c]) for row in rows) + 2 for c in range(n)) - 2 > most:
        head = [cell.split() for cell in rows[0]]
    height = max(map(len, head))
    head = [[""] * (height - len(words)) + words for words in head]
    lines = [*zip(*head, strict=True), *rows[1:]]
    widths = [max(len(line[column]) for line in lines) for column in range(n)]
    texts = ["  ".join(cell.rjust(w) for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines]
    texts.insert(height, "  ".join("─" * width for width in widths))
    return "\n".join(texts)


def for_screen(rows: Sequence[Sequence[str]]) -> str:
    """The rows aligned for the terminal, if there is one, without columns that hold nothing below their title."""
    filled = [any(row[column] for row in rows[1:]) for column in range(len(rows[0]))]
    kept = [[cell for cell, keep in zip(row, filled, strict=True) if keep] for row in rows]
    return aligned(kept, most=shutil.get_terminal_size().columns if sys.stdout.isatty() else None)


def final_log_likelihoods(result: dict[str, Any]) -> list[list[float]]:
    """The last held-out log-likelihood of each pretrained model, one number a replica; [] where none was found."""
    record = result["stages"].get("pretrain", {})
    last = {value["layer"]: value["heldout"] for value in record.get("log_likelihood", [])}
    return [last.get(layer, []) for layer in range(len(record.get("trained", [])))]


def run_table(result: dict[str, Any]) -> str:
    """What each stage of one run reached, what simple models reach, and what held-out images chose for the run."""
    title = ["stage", "iterations", "energy gap (data - model)", LIKELIHOOD_TITLE, "test accuracy", "wall time"]
    rows = [title]
    likelihoods = final_log_likelihoods(result)
    for name, record in result["stages"].items():
        gaps, asked = record.get("energy_gap", []), record["iterations"]
        # Fewer than asked for where something ended the stage before.
        passes = [str(n) if n == asked else f"{n} of {asked}" for n in record.get("passes", [])]
        passes = passes or [str(asked)] * max(1, len(gaps))
        for layer, (trained, n, gap) in enumerate(zip(record.get("trained", []), passes, gaps, strict=False)):
            nats = with_error(likelihoods[layer], digits=2) if likelihoods[layer] else ""
            rows.append([f"{name} {trained}", n, with_error(gap), nats, "", ""])
        if name == "updown":
            rows.append([name, passes[0], "", "", "", ""])
        elif not gaps:
            learnt_from = f", {result['labels']:,} labels" if "labels" in result else ""
            accuracy = with_error(result["test_accuracy"])
            rows.append([f"{name}{learnt_from}", passes[0], "", "", accuracy, ""])
        rows[-1][-1] = f"{record['wall_time_s']:.1f} s"
    context = result.get("context", {})
    if (independent := context.get("independent_units")) is not None:
        rows.append(["(independent units)", "", "", f"{independent['heldout']:.2f}", "", ""])
    if (regression := context.get("logistic_regression")) is not None:
        rows.append(["(logistic regression)", "", "", "", f"{regression['test_accuracy']:.4f}", ""])
    choice = result.get("choice")
    chosen = f"\nChosen on held-out training images: {choice['setting']} = {choice['value']:g}" if choice else ""
    judged = result.get("validation_accuracy")
    held_out = f"\nAccuracy on held-out training images: {with_error(judged)}" if judged else ""
    return for_screen(rows) + chosen + held_out + _with_earlier_runs(result)


def _with_earlier_runs(result: dict[str, Any]) -> str:
    """A line on the passes of all runs of which each went on from the one before; nothing of the first."""
    if not result.get("history"):
        return ""
    passes = [
        f"{stage} {model} {n:,}" if model != "network" else f"{stage} {n:,}"
        for stage, models in result["total_passes"].items()
        for model, n in models.items()
    ]
    seen = f"\n{result['seen_before']}" if "seen_before" in result else ""
    return f"\nGoes on from {result['history'][-1]['run']}. Passes in all: {', '.join(passes)}{seen}"


def closing_lines(folder: Path) -> str:
    """Where the run is and how to look at it; the command works in a virtual environment that is not active."""
    place = f"\nRun folder:   {folder}"
    if not any(folder.rglob("events.out.tfevents.*")):
        return place
    beside_python = Path(sys.executable).parent / "tensorboard"
    command = "tensorboard" if shutil.which("tensorboard") else short_path(beside_python)
    return f"{place}\nTensorBoard:  {shlex.join([str(command), '--logdir', str(folder)])}"


def short_path(path: Path) -> Path:
    """The path as a person in the current folder would type it."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
