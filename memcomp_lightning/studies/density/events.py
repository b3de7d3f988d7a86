"""What TensorBoard shows of a comparison of density models: a run a model, its charts by table."""

import shutil
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from memcomp_lightning.files import inside
from memcomp_lightning.studies.density.results import Densities
from memcomp_lightning.studies.worth_report import write_event_file

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


def write_events(results: Densities, folder: Path) -> None:
    """Curves of held-out and training rows, medians over seeds, at the chosen settings; test rows at the end."""
    shutil.rmtree(folder, ignore_errors=True)
    for name in results.plan.models:
        if any(results.reported(table, name) for table in results.tables):
            write_event_file(inside(folder, results.label(name)), partial(_write, results, name))


def _write(results: Densities, name: str, writer: "SummaryWriter") -> None:
    for table in results.tables:
        for record in results.reported(table, name):
            for rows, measure in (("held-out", "valid"), ("training", "train"), ("log Z gap", "log_z_gap")):
                for updates, value in zip(record.at, np.median(record.measured(measure), axis=1), strict=True):
                    writer.add_scalar(f"{table}/{rows}", value, updates)
            found = results.of(table)[name]
            if found.known:
                writer.add_scalar(f"{table}/test", found.mean, record.at[-1])
