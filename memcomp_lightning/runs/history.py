"""The runs that a run goes on from, and how many passes they make together."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from omegaconf import OmegaConf

from memcomp_lightning.runs.folder import RunFolder

Passes = dict[str, dict[str, int]]
"""Of the models of each stage: ``{"pretrain": {"layer 1": 10}, "finetune": {"network": 50}}``."""


def passes_of(stages: Mapping[str, Mapping[str, Any]]) -> Passes:
    """Passes of each model, from the records of the stages of a run."""
    found = {}
    for stage, record in stages.items():
        names = record.get("trained", ["network"])
        found[stage] = dict(zip(names, record.get("passes") or [record["iterations"]] * len(names), strict=False))
    return found


def history_with(earlier: RunFolder, weights: str) -> list[dict[str, Any]]:
    """The history of a run that goes on from another.

    Args:
        earlier: That run, finished.
        weights: The stage whose weights it goes on from: "pretrain" or "finetune".
    """
    result, settings = earlier.result, earlier.settings
    assert result is not None
    assert settings is not None
    last = {
        "run": str(earlier.path),
        "weights": weights,
        "passes": passes_of(result["stages"]),
        "settings": cast(dict[str, Any], OmegaConf.to_container(settings)),
    }
    return [*earlier.history, last]


def seen_before(earlier: RunFolder, rows: Mapping[str, str]) -> str:
    """Which rows that judge a run may have been trained on by those that it goes on from; nothing where none.

    The same training rows are split as they were, and the same test rows were test rows then, too.

    Args:
        earlier: The run that it goes on from, finished.
        rows: Fingerprints of its own rows, as of :class:`memcomp_lightning.data.RowsDataModule`.
    """
    theirs, result = earlier.rows or {}, earlier.result or {}
    if said := result.get("seen_before"):
        return str(said)
    if theirs.get("train") == rows["train"]:
        return ""
    others = " and ".join(name for name in ("test", "held-out") if name in rows and rows[name] != theirs.get(name))
    return others and (
        f"The {others} rows may be among those that {earlier.path} was trained on: its rows were others. They are "
        "safe with the same data, or with the same files data.test=FILE and data.validation=FILE in both runs."
    )


def total_passes(history: Sequence[Mapping[str, Any]], own: Passes) -> Passes:
    """Passes that led to the weights of a run, over its history.

    A fine-tuning that followed upon more pretraining began anew: those before it do not count.
    """
    total: Passes = {}
    for number, run in enumerate(history):
        began_anew = any(later["weights"] == "pretrain" for later in history[number:])
        for stage, passes in run["passes"].items():
            if stage == "pretrain" or not began_anew:
                _add(total, stage, passes)
    for stage, passes in own.items():
        _add(total, stage, passes)
    return total


def short(history: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Which runs these are, and their passes, without their settings."""
    return [{"run": Path(run["run"]).as_posix(), "passes": run["passes"]} for run in history]


def _add(total: Passes, stage: str, passes: Mapping[str, int]) -> None:
    there = total.setdefault(stage, {})
    for name, n in passes.items():
        there[name] = there.get(name, 0) + n
