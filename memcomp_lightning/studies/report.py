"""What a study shows, written into its folder: pictures, tables, verdicts, and its part of a page."""

import io
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

from matplotlib.figure import Figure

from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.files import as_csv, inside, read_json, write_text, written_whole
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
from memcomp_lightning.studies.verdicts import RULE, Verdict, verdicts
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
        notes = read_json(folder / "figure2.json")
        return Section(notes["title"], [("Fig. 2", picture.read_bytes())], [], notes["notes"])
    notes, origin = [], folder / "origin.json"
    if origin.exists():
        made_by = read_json(origin)
        notes.append(", ".join(f"{key} {value}" for key, value in made_by.items()))
    shown = next((show for file, show in _BY_FILE.items() if (folder / file).exists()), _of_figure)(folder)
    write_text(inside(folder, f"{shown.name}.csv"), shown.numbers)
    write_text(folder / "verdicts.md", markdown(shown.verdicts))
    pictures = [(caption, save(folder, caption, figure)) for caption, figure in shown.figures.items()]
    notes += [*shown.notes, f"Numbers: {shown.name}.csv"]
    return Section(shown.title, pictures, shown.verdicts, notes, shown.rule)


class _Shown(NamedTuple):
    """What a study shows: figures by caption, numbers as CSV, verdicts and how they are made."""

    name: str
    title: str
    rule: str
    figures: Mapping[str, Figure]
    numbers: str
    verdicts: Sequence[Verdict]
    notes: Sequence[str] = ()


T = TypeVar("T")


def _read(reader: Callable[[Path], T], folder: Path) -> T:
    """What a reader finds in a folder, whose files may be damaged, or of another version."""
    try:
        return reader(folder)
    except SettingError:
        raise
    except (ValueError, LookupError, TypeError, AttributeError) as error:
        raise UserError(
            f"{folder}: its files are damaged, or another version wrote them ({type(error).__name__}: {error})"
        ) from error


def _of_worth(folder: Path) -> _Shown:
    worth = _read(read_worth, folder)
    _check_measured(folder, bool(worth.data_sets))
    write_events(worth, folder / "tensorboard")
    figures = {data_set: plot_worth(worth, data_set) for data_set in worth.data_sets}
    numbers = as_csv(worth_table(worth))
    return _Shown("sampler_worth", worth.plan.title, WORTH_RULE, figures, numbers, worth_verdicts(worth))


def _of_density(folder: Path) -> _Shown:
    found = _read(read_densities, folder)
    _check_measured(folder, bool(found.tables))
    density_events(found, folder / "tensorboard")
    plan, numbers = found.plan, as_csv(density_table(found))
    return _Shown(plan.name, plan.title, DENSITY_RULE, density_figures(found), numbers, density_verdicts(found))


def _of_few_labels(folder: Path) -> _Shown:
    found = _read(read_few_labels, folder)
    _check_measured(folder, bool(found.labels))
    plan, numbers, judged = found.plan, as_csv(few_labels_table(found)), few_labels_verdicts(found)
    figures, notes = few_labels_figures(found), [worth_note(found)]
    return _Shown(plan.name, plan.title, FEW_LABELS_RULE, figures, numbers, judged, notes)


def _of_figure(folder: Path) -> _Shown:
    results = _read(read_results, folder)
    _check_measured(folder, bool(results.curves))
    plan, notes = results.plan, [f"Training took {results.seconds / 60:.1f} min of one core."]
    title, figures = f"{plan.name}: {plan.data}, {plan.title}", accuracy_figures(results)
    return _Shown(plan.name, title, RULE, figures, results.table(), verdicts(results), notes)


_BY_FILE = {"worth.json": _of_worth, "density.json": _of_density, "few_labels.json": _of_few_labels}
"""By the file in which a study keeps its settings; figures are the others."""


def _check_measured(folder: Path, measured: bool) -> None:
    if not measured:
        command = shlex.join(["memcomp-train", f"resume={folder}"])
        raise UserError(f"{folder} has no records yet: go on with {command}")


def save(folder: Path, name: str, figure: Figure) -> bytes:
    """Write a figure as PNG and SVG and to TensorBoard; return the PNG."""
    for suffix in ("svg", "png"):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=suffix, dpi=130)
        with written_whole(inside(folder, f"{name}.{suffix}")) as path:
            path.write_bytes(buffer.getvalue())
    write_event_file(folder, lambda writer: writer.add_figure(name, figure, close=False))
    return buffer.getvalue()
