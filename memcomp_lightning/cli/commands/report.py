"""``memcomp-report``: figures, tables and verdicts from run folders of ``experiment=figure4`` and the like."""

import argparse
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from memcomp_lightning.cli.arguments import as_typed
from memcomp_lightning.cli.errors import UserError, in_words, refuse
from memcomp_lightning.cli.event_files import event_file
from memcomp_lightning.cli.output import say
from memcomp_lightning.cli.table import aligned, short_path
from memcomp_lightning.cli.worth_report import write_worth
from memcomp_lightning.errors import SettingError
from memcomp_lightning.files import write_text, written_whole
from memcomp_lightning.plotting import plot_against_iterations, plot_against_passes, plot_controls
from memcomp_lightning.report import Section, Verdict, markdown, page, read_results, verdicts
from memcomp_lightning.report.worth import WORTH_RULE, read_worth

COMMAND = "memcomp-report"


def report(folder: Path) -> Section:
    """Write what a run folder shows into it: PNG, SVG, CSV, verdicts, TensorBoard; return its part of the page.

    Raises:
        UserError: The folder holds no figure, or nothing was measured yet.
    """
    picture = folder / "figure2.png"
    if picture.exists():
        notes = json.loads((folder / "figure2.json").read_text(encoding="utf-8"))
        return Section(notes["title"], [("Fig. 2", picture.read_bytes())], [], notes["notes"])
    if (folder / "worth.json").exists():
        return _report_worth(folder)
    try:
        results = read_results(folder)
    except FileNotFoundError as error:
        raise UserError(str(error)) from error
    if not results.curves:
        raise UserError(f"{folder} has no records yet: go on with {as_typed('memcomp-train', f'resume={folder}')}")
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
        raise UserError(f"{folder} has no courses yet: go on with {as_typed('memcomp-train', f'resume={folder}')}")
    figures, judged, notes = write_worth(worth, folder)
    pictures = [(title, save(folder, title, figure)) for title, figure in figures.items()]
    return Section(worth.plan["title"], pictures, judged, [*_origin(folder), *notes], WORTH_RULE)


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


def verdict_table(judged: Sequence[Verdict]) -> str:
    """Verdicts for the screen."""
    rows = [["claim", "measured", "difference", "verdict"]]
    for claim, measured, test, verdict, controls in judged:
        rows.append([claim, measured, test, verdict + (f" ({len(controls)})" if controls else "")])
    return aligned(rows)


def _origin(folder: Path) -> list[str]:
    path = folder / "origin.json"
    if not path.exists():
        return []
    origin: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return [", ".join(f"{key} {value}" for key, value in origin.items())]


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog=COMMAND,
        description="Write figures, tables and verdicts of runs like memcomp-train experiment=figure4.",
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="folder of a run of a figure")
    parser.add_argument("--output", type=Path, help="the page; default: report.html in the first folder")
    parser.error = lambda message: refuse(COMMAND, UserError(f"{message}. {COMMAND} --help shows how."))  # type: ignore[method-assign]
    given = parser.parse_args(arguments)
    try:
        sections = [report(folder) for folder in given.folders]
        output = given.output or given.folders[0] / "report.html"
        write_text(output, page(sections))
    except (UserError, SettingError) as error:
        refuse(COMMAND, error)
    except OSError as error:
        refuse(COMMAND, UserError(in_words(error)))
    for section in sections:
        if section.verdicts:
            say(f"\n{section.title}\n{verdict_table(section.verdicts)}")
    say(f"\nReport:  {short_path(output.absolute())}")
