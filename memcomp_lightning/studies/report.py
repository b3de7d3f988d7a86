"""What a study shows, written into its folder: pictures, tables, verdicts, and its part of a page."""

import io
import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from memcomp_lightning.files import write_text, written_whole
from memcomp_lightning.studies.event_files import event_file
from memcomp_lightning.studies.page import Section, markdown
from memcomp_lightning.studies.plot_accuracy import plot_against_iterations, plot_against_passes, plot_controls
from memcomp_lightning.studies.results import read_results
from memcomp_lightning.studies.verdicts import verdicts
from memcomp_lightning.studies.worth import WORTH_RULE, read_worth
from memcomp_lightning.studies.worth_report import write_worth


class NothingMeasuredError(ValueError):
    """A study has not left a record yet."""


def write_report(folder: Path) -> Section:
    """Write what a run folder shows into it: PNG, SVG, CSV, verdicts, TensorBoard; return its part of the page.

    Raises:
        FileNotFoundError: The folder holds no study.
        NothingMeasuredError: Nothing was measured yet.
    """
    picture = folder / "figure2.png"
    if picture.exists():
        notes = json.loads((folder / "figure2.json").read_text(encoding="utf-8"))
        return Section(notes["title"], [("Fig. 2", picture.read_bytes())], [], notes["notes"])
    if (folder / "worth.json").exists():
        return _report_worth(folder)
    results = read_results(folder)
    if not results.curves:
        raise NothingMeasuredError(f"{folder} has no records yet")
    name = results.plan.name
    write_text(folder / f"{name}.csv", results.table())
    judged = verdicts(results)
    write_text(folder / "verdicts.md", markdown(judged))
    figures = {f"{name}_controls": plot_controls(results)}
    if results.plan.against == "passes":
        figures = {name: plot_against_passes(results), **figures}
    elif any(len(results.lengths(curve)) > 1 for curve in results.curves):
        figures = {name: plot_against_iterations(results), **figures}
    pictures = [(title, save(folder, title, figure)) for title, figure in figures.items()]
    time = f"Training took {results.seconds / 60:.1f} min of one core."
    notes = [*_origin(folder), time, f"Numbers: {name}.csv"]
    return Section(f"{name}: {results.plan.data}, {results.plan.title}", pictures, judged, notes)


def _report_worth(folder: Path) -> Section:
    """The same of a comparison of samplers."""
    worth = read_worth(folder)
    if not worth.data_sets:
        raise NothingMeasuredError(f"{folder} has no records yet")
    figures, judged, notes = write_worth(worth, folder)
    pictures = [(title, save(folder, title, figure)) for title, figure in figures.items()]
    return Section(worth.plan.title, pictures, judged, [*_origin(folder), *notes], WORTH_RULE)


def save(folder: Path, name: str, figure: Figure) -> bytes:
    """Write a figure as PNG and SVG and to TensorBoard; return the PNG."""
    for suffix in ("svg", "png"):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, dpi=130)
        with written_whole(folder / f"{name}.{suffix}") as path:
            path.write_bytes(buffer.getvalue())
    with event_file(folder) as writer:
        if writer is not None:
            writer.add_figure(name, figure, close=False)
    return buffer.getvalue()


def _origin(folder: Path) -> list[str]:
    path = folder / "origin.json"
    if not path.exists():
        return []
    origin: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return [", ".join(f"{key} {value}" for key, value in origin.items())]
