"""TensorBoard's event files: of all studies, and what they show of ``experiment=sampler_worth``."""

import logging
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from memcomp_lightning.files import inside
from memcomp_lightning.studies.measures import MEASURES
from memcomp_lightning.studies.worth import Worth

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

log = logging.getLogger(__name__)


def write_event_file(folder: Path, write: Callable[["SummaryWriter"], None]) -> None:
    """Let ``write`` fill an event file of a folder; say so where TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError:
        log.warning("TensorBoard is not installed: %s gets no event file. pip install tensorboard", folder)
        return
    with SummaryWriter(str(folder)) as writer:
        write(writer)


def write_events(worth: Worth, folder: Path) -> None:
    """A run for each method at its best rates, a group of charts for each data set, settings in the HParams tab.

    One run for all data sets: TensorBoard shows nothing at first where there are more than forty.
    """
    shutil.rmtree(folder, ignore_errors=True)
    charts = {}
    for data_set in worth.data_sets:
        label, measure = worth.plan.data_sets[data_set].label, worth.plan.data_sets[data_set].measure
        name = MEASURES[measure].title
        tags = {
            f"{name}: median over replicas": f"{data_set}/{measure}/median",
            f"{name}: worst replica": f"{data_set}/{measure}/worst",
            "gradient: cosine with the exact one": f"{data_set}/gradient/cosine",
            "gradient: relative error": f"{data_set}/gradient/relative_error",
        }
        charts[label] = {title: ["Multiline", [tag]] for title, tag in tags.items()}
    for method, own in worth.plan.methods.items():
        found = [data_set for data_set in worth.data_sets if method in worth.methods(data_set)]
        if found:
            write_event_file(inside(folder, own.label), partial(_write_method, worth, method, found))
    write_event_file(folder, lambda writer: writer.add_custom_scalars(charts))


def _write_method(worth: Worth, method: str, data_sets: list[str], writer: "SummaryWriter") -> None:
    from torch.utils.tensorboard.summary import hparams

    settings: dict[str, object] = {"method": worth.plan.methods[method].label}
    final = {}
    for data_set in data_sets:
        record, measure = worth.best(data_set, method), worth.plan.data_sets[data_set].measure
        scores, cosines, errors = (worth.values(record, name) for name in ("score", "cosine", "relative_error"))
        values = {
            f"{data_set}/{measure}/median": np.median(scores, axis=1),
            f"{data_set}/{measure}/worst": scores.max(axis=1),
            f"{data_set}/gradient/cosine": np.median(cosines, axis=1),
            f"{data_set}/gradient/relative_error": np.median(errors, axis=1),
            f"{data_set}/seconds": np.array(record.seconds),
        }
        for tag, curve in values.items():
            for updates, value in zip(record.at, curve, strict=True):
                writer.add_scalar(tag, value, updates)
        end = worth.end(data_set, method)
        settings[f"learning_rate/{data_set}"] = end.rate
        for name in ("median", "worst", "seconds"):
            final[f"final/{data_set}/{name}"] = getattr(end, name)
            writer.add_scalar(f"final/{data_set}/{name}", getattr(end, name), record.at[-1])
    file_writer: Any = writer.file_writer
    for summary in hparams(settings, final):
        file_writer.add_summary(summary)
