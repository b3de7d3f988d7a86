"""The results of many runs as one table."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from memcomp_lightning.files import as_csv, write_text
from memcomp_lightning.runs import table


def sweep_table(groups: Mapping[tuple[tuple[str, str], ...], Sequence[dict[str, Any]]], path: Path) -> str:
    """A row for each setting, for the screen; the same as CSV in a file.

    Mean and standard error are over seeds and replicas. Settings that all runs share are left out. Results are
    grouped by all settings but the seed.
    """
    settings = [dict(key) for key in groups]
    names = list(dict.fromkeys(name for setting in settings for name in setting))
    swept = [name for name in names if len({setting.get(name) for setting in settings}) > 1]
    held_out = any(result.get("validation_accuracy") for results in groups.values() for result in results)
    measures = [measure for measure in _MEASURES if held_out or measure.name != "validation_accuracy"]
    screen = [[*swept, "runs x replicas", *(measure.title for measure in measures), "wall time"]]
    numbers = [f"{measure.name}_{what}" for measure in measures for what in ("mean", "error")]
    sheet: list[list[object]] = [[*swept, "n_runs", "n_values", *numbers, "wall_time_s"]]
    rows = zip(settings, groups.values(), strict=True)
    for setting, results in sorted(rows, key=lambda row: _order(row[0], swept)):
        found = {m.name: [x for result in results for x in m.of(result)] for m in measures}
        seconds = [sum(record["wall_time_s"] for record in result["stages"].values()) for result in results]
        own, mean_s = [setting.get(name, "") for name in swept], sum(seconds) / len(seconds)
        n_values = max(len(found["energy_gap"]), len(found["test_accuracy"]))
        cells = [table.with_error(found[m.name], digits=m.digits) if found[m.name] else "" for m in measures]
        screen.append([*own, f"{len(results)} x {n_values // len(results)}", *cells, f"{mean_s:.1f} s"])
        pairs = [table.mean_and_error(values) if values else ("", "") for values in found.values()]
        sheet.append([*own, len(results), n_values, *(x for pair in pairs for x in pair), mean_s])
    write_text(path, as_csv(sheet))
    return table.for_screen(screen)


class _Measure(NamedTuple):
    """A column: its name in the CSV, its title on the screen, its numbers in the result of a run."""

    name: str
    title: str
    of: Callable[[dict[str, Any]], list[float]]
    digits: int = 4


_MEASURES = (
    _Measure(
        "energy_gap",
        "energy gap, top layer",
        lambda result: (result["stages"].get("pretrain", {}).get("energy_gap") or [[]])[-1],
    ),
    _Measure(
        "log_likelihood",
        f"{table.LIKELIHOOD_TITLE}, first layer",
        lambda result: [x for layer in table.final_log_likelihoods(result)[:1] for x in layer],
        digits=2,
    ),
    _Measure("validation_accuracy", "held-out accuracy", lambda result: result.get("validation_accuracy", [])),
    _Measure("test_accuracy", "test accuracy", lambda result: result.get("test_accuracy", [])),
)


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
