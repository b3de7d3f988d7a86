"""The results of many runs as one table."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from memcomp_lightning.files import write_text
from memcomp_lightning.runs.table import (
    LIKELIHOOD_TITLE,
    aligned,
    final_log_likelihoods,
    mean_and_error,
    with_error,
    without_empty_columns,
)


def sweep_table(groups: Mapping[tuple[tuple[str, str], ...], Sequence[dict[str, Any]]], path: Path) -> str:
    """Write the results of a sweep as CSV, and return them as a table for the screen: a row for each setting.

    Mean and standard error are over seeds and replicas. Settings that all runs share are left out.

    Args:
        groups: Results of runs, by their settings but the seed.
        path: Of the CSV.
    """
    settings = [dict(key) for key in groups]
    names = list(dict.fromkeys(name for setting in settings for name in setting))
    swept = [name for name in names if len({setting.get(name) for setting in settings}) > 1]
    held_out = any("validation_accuracy" in result for results in groups.values() for result in results)
    held_out_title = ["held-out accuracy"] if held_out else []
    screen = [
        [
            *swept,
            "runs x replicas",
            "energy gap, top layer",
            f"{LIKELIHOOD_TITLE}, first layer",
            *held_out_title,
            "test accuracy",
            "wall time",
        ]
    ]
    sheet: list[list[Any]] = [
        [
            *swept,
            "n_runs",
            "n_values",
            "energy_gap_mean",
            "energy_gap_error",
            "log_likelihood_mean",
            "log_likelihood_error",
            *(["validation_accuracy_mean", "validation_accuracy_error"] if held_out else []),
            "test_accuracy_mean",
            "test_accuracy_error",
            "wall_time_s",
        ]
    ]
    for setting, results in sorted(
        zip(settings, groups.values(), strict=True), key=lambda pair: _order(pair[0], swept)
    ):
        gaps = [
            gap
            for result in results
            for gap in (result["stages"].get("pretrain", {}).get("energy_gap") or [[]])[-1]
        ]
        nats = [value for result in results for layer in final_log_likelihoods(result)[:1] for value in layer]
        accuracies = [accuracy for result in results for accuracy in result.get("test_accuracy", [])]
        judged = [accuracy for result in results for accuracy in result.get("validation_accuracy", [])]
        seconds = [sum(record["wall_time_s"] for record in result["stages"].values()) for result in results]
        values = [setting.get(name, "") for name in swept]
        n_values = max(len(gaps), len(accuracies))
        screen.append(
            [
                *values,
                f"{len(results)} x {n_values // len(results)}",
                with_error(gaps) if gaps else "",
                with_error(nats, digits=2) if nats else "",
                *([with_error(judged) if judged else ""] if held_out else []),
                with_error(accuracies) if accuracies else "",
                f"{sum(seconds) / len(seconds):.1f} s",
            ]
        )
        sheet.append(
            [
                *values,
                len(results),
                n_values,
                *(mean_and_error(gaps) if gaps else ("", "")),
                *(mean_and_error(nats) if nats else ("", "")),
                *((mean_and_error(judged) if judged else ("", "")) if held_out else ()),
                *(mean_and_error(accuracies) if accuracies else ("", "")),
                sum(seconds) / len(seconds),
            ]
        )
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(sheet)
    write_text(path, buffer.getvalue())
    return aligned(without_empty_columns(screen))


def _order(setting: dict[str, str], names: list[str]) -> list[tuple[int, float, str]]:
    """Sort key: numbers by value, before words."""
    key: list[tuple[int, float, str]] = []
    for name in names:
        value = setting.get(name, "")
        try:
            key.append((0, float(value), ""))
        except ValueError:
            key.append((1, 0.0, value))
    return key
