"""Multirun: one merged table at the end."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from hydra.experimental.callback import Callback
from omegaconf import DictConfig

from memcomp_lightning.cli.arguments import Planned
from memcomp_lightning.errors import LostError
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.sweep_table import sweep_table
from memcomp_lightning.runs.table import short_path


class RememberSweepFolder(Callback):
    """Hydra callback: keeps of a multirun its folder, for the table at its end, and nothing of its jobs."""

    folder: Path | None = None
    made: int | None = None
    """What the system calls the folder since its first job, of a launcher that runs jobs in this process."""

    def on_multirun_start(self, config: DictConfig, **kwargs: object) -> None:
        """Called once, before the jobs."""
        RememberSweepFolder.folder, RememberSweepFolder.made = Path(config.hydra.sweep.dir).absolute(), None

    def on_job_start(self, config: DictConfig, **kwargs: object) -> None:
        """Called before each job, whose folder is there."""
        if self.folder is not None and self.made is None:
            RememberSweepFolder.made = self.folder.stat().st_ino

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: object) -> None:
        """Called after each job. A launcher keeps what it returned until the last: a third of a mebibyte a job."""
        job_return.cfg = job_return.hydra_cfg = None


def merge(folder: Path, planned: Sequence[Planned] = ()) -> tuple[str, int]:
    """Write the jobs of a sweep folder as ``table.csv``; return the table for the screen, and how many failed.

    Rows are settings, see :func:`sweep_table`. Reports of figures and comparisons are listed, and failed jobs; so
    is a planned job that has left nothing in the folder, whatever its launcher said of it.

    Raises:
        LostError: The folder is not the one in which the jobs began.
    """
    if RememberSweepFolder.made not in (None, folder.stat().st_ino if folder.is_dir() else None):
        raise LostError(f"{folder} vanished while jobs ran, and was made anew without them: bring them back.")
    groups: dict[tuple[tuple[str, str], ...], list[dict[str, Any]]] = defaultdict(list)
    failed: list[tuple[str, str]] = []
    reports: list[Path] = []
    # Launchers keep their own files in folders such as .submitit.
    inside = folder.iterdir() if folder.is_dir() else ()
    there = sorted(path for path in inside if path.is_dir() and not path.name.startswith("."))
    for path in there:
        job = RunFolder(path)
        if job.report.exists() and job.error is None:
            reports.append(job.report)
        elif (result := job.result) is not None:
            groups[tuple((k, v) for k, v in result["overrides"].items() if k != "seed")].append(result)
        else:
            failed.append((path.name, (job.error or {"error": "did not finish"})["error"]))
    failed += [
        (job.folder or " ".join(job.overrides), f"left nothing in {short_path(folder)}: its launcher lost it")
        for job in _without_folder(planned, there)
    ]
    text = sweep_table(groups, folder / "table.csv") if groups else ""
    text += "".join(f"Report:  {short_path(path)}\n" for path in reports)
    text = text or "No job has finished."
    if failed:
        listing = "\n".join(f"  {name}\n    {error}" for name, error in failed)
        text += f"\n\n{len(failed)} failed; start the same sweep again to repeat only these:\n{listing}"
    return text, len(failed)


def _without_folder(planned: Sequence[Planned], there: Sequence[Path]) -> list[Planned]:
    """Jobs that no folder has the name of, nor the settings."""
    names = {path.name for path in there}
    unnamed = [job for job in planned if job.folder not in names]
    if not unnamed:
        return []
    begun = [sorted(o for o in RunFolder(path).overrides or () if not o.startswith("hydra.")) for path in there]
    return [job for job in unnamed if sorted(job.overrides) not in begun]
