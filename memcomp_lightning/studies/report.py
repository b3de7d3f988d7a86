"""What a study shows, written into its folder: pictures, tables, verdicts, and its part of a page."""

import io
import json
import shlex
from pathlib import Path

from matplotlib.figure import Figure

from memcomp_lightning.errors import UserError
from memcomp_lightning.files import as_csv, write_text, written_whole
from memcomp_lightning.studies.density import read_densities
from memcomp_lightning.studies.density.events import write_events as density_events
from memcomp_lightning.studies.density.plot import density_figures
from memcomp_lightning.studies.density.results import DENSITY_RULE, density_table, density_verdicts
from memcomp_lightning.studies.few_labels import read_few_labels
from memcomp_lightning.studies.few_labels.plot import few_labels_figures
from memcomp_lightning.studies.few_labels.results import (
    FEW_LABELS_RULE,
    few_labels_table,
    few_labels_verdicts,
    worth_note,
)
from memcomp_lightning.studies.page import Section, markdown
from memcomp_lightning.studies.plot_accuracy import accuracy_figures
from memcomp_lightning.studies.plot_worth import plot_worth
from memcomp_lightning.studies.results import read_results
from memcomp_lightning.studies.verdicts import RULE, verdicts
from memcomp_lightning.studies.worth import WORTH_RULE, read_worth, worth_table, worth_verdicts
from memcomp_lightning.studies.worth_report import write_event_file, write_events


def write_report(folder: Path) -> Section:
    """Write what a run folder shows into it: PNG, SVG, CSV, verdicts, TensorBoard; return its part of the page.

    Raises:
        FileNotFoundError: The folder holds no study.
        UserError: Nothing was measured yet.
    """
    picture = folder / "figure2.png"
    if picture.exists():
        notes = json.loads((folder / "figure2.json").read_text(encoding="utf-8"))
        return Section(notes["title"], [("Fig. 2", picture.read_bytes())], [], notes["notes"])
    notes, origin = [], folder / "origin.json"
    if origin.exists():
        made_by = json.loads(origin.read_text(encoding="utf-8"))
        notes.append(", ".join(f"{key} {value}" for key, value in made_by.items()))
    if (folder / "worth.json").exists():
        worth = read_worth(folder)
        _check_measured(folder, bool(worth.data_sets))
        name, title, rule = "sampler_worth", worth.plan.title, WORTH_RULE
        figures = {data_set: plot_worth(worth, data_set) for data_set in worth.data_sets}
        numbers, judged = as_csv(worth_table(worth)), worth_verdicts(worth)
        write_events(worth, folder / "tensorboard")
    elif (folder / "density.json").exists():
        densities = read_densities(folder)
        _check_measured(folder, bool(densities.tables))
        name, title, rule = densities.plan.name, densities.plan.title, DENSITY_RULE
        figures, numbers = density_figures(densities), as_csv(density_table(densities))
        judged = density_verdicts(densities)
        density_events(densities, folder / "tensorboard")
    elif (folder / "few_labels.json").exists():
        accuracies = read_few_labels(folder)
        _check_measured(folder, bool(accuracies.labels))
        name, title, rule = accuracies.plan.name, accuracies.plan.title, FEW_LABELS_RULE
        figures, numbers = few_labels_figures(accuracies), as_csv(few_labels_table(accuracies))
        judged = few_labels_verdicts(accuracies)
        notes.append(worth_note(accuracies))
    else:
        results = read_results(folder)
        _check_measured(folder, bool(results.curves))
        plan, rule = results.plan, RULE
        name, title = plan.name, f"{plan.name}: {plan.data}, {plan.title}"
        figures = accuracy_figures(results)
        numbers, judged = results.table(), verdicts(results)
        notes.append(f"Training took {results.seconds / 60:.1f} min of one core.")
    write_text(folder / f"{name}.csv", numbers)
    write_text(folder / "verdicts.md", markdown(judged))
    pictures = [(caption, save(folder, caption, figure)) for caption, figure in figures.items()]
    return Section(title, pictures, judged, [*notes, f"Numbers: {name}.csv"], rule)


def _check_measured(folder: Path, measured: bool) -> None:
    if not measured:
        command = shlex.join(["memcomp-train", f"resume={folder}"])
        raise UserError(f"{folder} has no records yet: go on with {command}")


def save(folder: Path, name: str, figure: Figure) -> bytes:
    """Write a figure as PNG and SVG and to TensorBoard; return the PNG."""
    for suffix in ("svg", "png"):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, dpi=130)
        with written_whole(folder / f"{name}.{suffix}") as path:
            path.write_bytes(buffer.getvalue())
    write_event_file(folder, lambda writer: writer.add_figure(name, figure, close=False))
    return buffer.getvalue()
