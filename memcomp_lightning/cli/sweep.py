"""Multirun: every job checked before the first one trains, one merged table at the end."""

import csv
import hashlib
import io
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.cli.build import build
from memcomp_lightning.cli.errors import CONFIGURATION_ERRORS, UserError, explain, unknown_setting
from memcomp_lightning.cli.pipeline import make_trainer
from memcomp_lightning.cli.run_folder import RunFolder, write_text
from memcomp_lightning.cli.table import aligned, mean_and_error, with_error

CONFIG_MODULE = "memcomp_lightning.conf"


LONGEST_NAME = 150
"""Characters of a job's folder; file systems allow 255."""


def job_folder(overrides: str) -> str:
    """Name of a job's folder: its overrides, as one path component that every file system takes.

    >>> job_folder("sampler=cd,model.weights=runs/a.pt")
    'sampler=cd,model.weights=runs_a.pt'
    """
    name = overrides.replace("/", "_").replace("\\", "_")
    if len(name) > LONGEST_NAME:
        name = f"{name[:LONGEST_NAME]}_{hashlib.sha256(overrides.encode()).hexdigest()[:8]}"
    return name or "job"


OmegaConf.register_new_resolver("memcomp_job_folder", job_folder, replace=True)


class RememberSweepFolder(Callback):
    """Hydra callback: keeps the folder of the multirun of this process, for the table at its end."""

    folder: Path | None = None

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Called once, before the jobs."""
        RememberSweepFolder.folder = Path(config.hydra.sweep.dir).absolute()


def check_overrides(overrides: Sequence[str], *, multirun: bool) -> None:
    """Build every job that the overrides stand for, and train none.

    Raises:
        UserError: Naming the setting, its value, what is allowed and, in a sweep, the job.
    """
    _check_writable(overrides, multirun=multirun)
    with initialize_config_module(CONFIG_MODULE, version_base="1.3"):
        try:
            jobs = _jobs(overrides) if multirun else [list(overrides)]
            defaults = compose("config", [o for o in jobs[0] if _chooses_group(o)])
        except CONFIGURATION_ERRORS as error:
            raise UserError(explain(error)) from error
        for message in (unknown_setting(override, defaults) for override in jobs[0]):
            if message is not None:
                raise UserError(message)
        for job in jobs:
            try:
                config = compose("config", job)
                plan = build(config)
                world_size = make_trainer(config, max_epochs=1, callbacks=[], loggers=[], folder=Path()).world_size
                for stage in plan.stages:
                    stage.data.train_batches(0, world_size)
            except CONFIGURATION_ERRORS as error:
                where = f" (job {' '.join(job)})" if multirun else ""
                raise UserError(explain(error) + where) from error


def _check_writable(overrides: Sequence[str], *, multirun: bool) -> None:
    """Raise unless a file can be made where the run folder will be."""
    key, default = ("hydra.sweep.dir", "multirun") if multirun else ("hydra.run.dir", "runs")
    given = dict(override.split("=", 1) for override in overrides if override.startswith(f"{key}="))
    folder = Path(given.get(key, default).strip("'\"")).absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise UserError(
            f"{key} = {folder} is not allowed: no file can be written in {existing} ({error.strerror}). Choose "
            f"another folder with {key}=PATH."
        ) from error


def _jobs(overrides: Sequence[str]) -> list[list[str]]:
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    (jobs,) = BasicSweeper.split_arguments(parsed, None)
    return jobs


def _chooses_group(override: str) -> bool:
    name, _, value = override.partition("=")
    return "." not in name and name not in ("seed",) and bool(value)


def merge(folder: Path) -> tuple[str, int]:
    """Merge the jobs of a sweep folder into one table and write it as ``table.csv``.

    Rows are settings; mean and standard error are over seeds and replicas. Settings that all jobs share
    are left out.

    Returns:
        The table with the failed jobs below it, and the number of these.
    """
    groups: dict[tuple[tuple[str, str], ...], list[dict[str, Any]]] = defaultdict(list)
    failed: list[tuple[str, str]] = []
    for path in sorted(path for path in folder.iterdir() if path.is_dir()):
        job = RunFolder(path)
        if (result := job.result) is not None:
            groups[tuple((k, v) for k, v in result["overrides"].items() if k != "seed")].append(result)
        else:
            failed.append((path.name, (job.error or {"error": "did not finish"})["error"]))
    text = _table(groups, folder) if groups else "No job has finished."
    if failed:
        listing = "\n".join(f"  {name}\n    {error}" for name, error in failed)
        text += f"\n\n{len(failed)} failed; start the same sweep again to repeat only these:\n{listing}"
    return text, len(failed)


def _table(groups: dict[tuple[tuple[str, str], ...], list[dict[str, Any]]], folder: Path) -> str:
    settings = [dict(key) for key in groups]
    names = list(dict.fromkeys(name for setting in settings for name in setting))
    swept = [name for name in names if len({setting.get(name) for setting in settings}) > 1]
    screen = [[*swept, "runs x replicas", "energy gap, top layer", "test accuracy", "wall time"]]
    sheet: list[list[Any]] = [
        [
            *swept,
            "n_runs",
            "n_values",
            "energy_gap_mean",
            "energy_gap_error",
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
        accuracies = [accuracy for result in results for accuracy in result.get("test_accuracy", [])]
        seconds = [sum(record["wall_time_s"] for record in result["stages"].values()) for result in results]
        values = [setting.get(name, "") for name in swept]
        n_values = max(len(gaps), len(accuracies))
        screen.append(
            [
                *values,
                f"{len(results)} x {n_values // len(results)}",
                with_error(gaps) if gaps else "",
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
                *(mean_and_error(accuracies) if accuracies else ("", "")),
                sum(seconds) / len(seconds),
            ]
        )
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(sheet)
    write_text(folder / "table.csv", buffer.getvalue())
    return aligned(screen)


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
