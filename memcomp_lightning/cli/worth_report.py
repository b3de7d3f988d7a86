"""The report of ``experiment=sampler_worth``: pictures, table, verdicts, and a layout for TensorBoard."""

import csv
import io
import shutil
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from memcomp_lightning.files import write_text
from memcomp_lightning.plotting import plot_worth
from memcomp_lightning.report import Verdict, markdown
from memcomp_lightning.report.worth import Course, Worth, worth_table, worth_verdicts

NUMBERS = "sampler_worth.csv"


def write_worth(worth: Worth, folder: Path) -> tuple[dict[str, Figure], list[Verdict], list[str]]:
    """Write table, verdicts and events into a folder; return pictures, verdicts and notes for the page."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(worth_table(worth))
    write_text(folder / NUMBERS, buffer.getvalue())
    judged = worth_verdicts(worth)
    write_text(folder / "verdicts.md", markdown(judged))
    _write_events(worth, folder / "tensorboard")
    figures = {name: plot_worth(worth, name) for name in worth.data_sets}
    return figures, judged, [f"Numbers: {NUMBERS}"]


def _write_events(worth: Worth, folder: Path) -> None:
    """A run for each method at its best rate, a group of charts for each data set, settings in the HParams tab."""
    shutil.rmtree(folder, ignore_errors=True)
    charts = {}
    for data_set in worth.data_sets:
        measure = worth.plan["data_sets"][data_set]["measure"]
        tags = {
            f"{measure}, median over replicas": [f"{data_set}/{measure}/median"],
            f"{measure}, worst replica": [f"{data_set}/{measure}/worst"],
            "gradient: cosine with the exact one": [f"{data_set}/gradient/cosine"],
            "gradient: relative error": [f"{data_set}/gradient/relative_error"],
        }
        charts[worth.plan["data_sets"][data_set]["label"]] = {
            title: ["Multiline", names] for title, names in tags.items()
        }
        for method in worth.methods(data_set):
            _write_course(worth, worth.best(data_set, method), measure, folder)
    with SummaryWriter(str(folder)) as writer:
        writer.add_custom_scalars(charts)


def _write_course(worth: Worth, course: Course, measure: str, folder: Path) -> None:
    scores, cosines, errors = (worth.values(course, name) for name in ("scores", "cosines", "errors"))
    values = {
        f"{course.data_set}/{measure}/median": np.median(scores, axis=1),
        f"{course.data_set}/{measure}/worst": scores.max(axis=1),
        f"{course.data_set}/gradient/cosine": np.median(cosines, axis=1),
        f"{course.data_set}/gradient/relative_error": np.median(errors, axis=1),
        f"{course.data_set}/seconds": np.array(course.seconds),
    }
    label = worth.plan["methods"][course.method]["label"]
    with SummaryWriter(str(folder / f"{label}" / course.data_set)) as writer:
        for tag, curve in values.items():
            for updates, value in zip(course.updates, curve, strict=True):
                writer.add_scalar(tag, value, updates)
        settings = {"data": course.data_set, "method": label, "learning_rate": course.rate}
        final = {"final/median": float(values[f"{course.data_set}/{measure}/median"][-1])}
        final |= {"final/worst": float(scores[-1].max()), "final/seconds": course.seconds[-1]}
        for summary in hparams(settings, final):
            writer.file_writer.add_summary(summary)
        for name, value in final.items():
            writer.add_scalar(name, value, course.updates[-1])
