"""The rows that a run was trained on, read again from where they lay."""

import inspect
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, NamedTuple

from memcomp_lightning.configuration.rows import rows_of
from memcomp_lightning.data.rows import UNLABELLED, Rows
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.paths import is_path
from memcomp_lightning.runs.trust import check_targets, resolved
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.values import visible_of


class TrainingRows(NamedTuple):
    """Rows of a run.

    Attributes:
        train: Those that it was trained on; evenly spaced ones of many.
        heldout: Those that it was not trained on, as evenly spaced.
    """

    train: Rows
    heldout: Rows


def training_rows(run: Run, *, most: int = 10_000) -> TrainingRows:
    """Read the data of a run again, by its own settings; nothing is downloaded.

    Args:
        run: Loaded from its folder.
        most: Rows of each kind.

    Raises:
        UserError: It does not say where its data are, or they are there no more, or have changed.
    """
    folder = RunFolder(run.path)
    config = folder.settings
    if folder.overrides is None or config is None:
        raise UserError(f"{run.path} lies by itself, and does not say where its data are")
    config.units = resolved(config.units, "units", folder.path)
    check_targets(config.units, "units", folder.path, run.trusted)
    source = _from_folder(resolved(config.data.source, "data.source", folder.path), "data.source", folder.typed_in)
    check_targets(source, "data.source", folder.path, run.trusted)
    if "download" in inspect.signature(resolve_name(source["_target_"])).parameters:
        source["download"] = False
    config.data.source = source
    try:
        data = rows_of(config, run.schema)
    except (UserError, SettingError, OSError, ValueError) as error:
        raise UserError(str(error).rstrip(".")) from error
    if data.schema is None or run.schema is None or data.schema.as_json() != run.schema.as_json():
        raise UserError("they have changed since")
    train, (v, label), observed = data.some_train(), data.heldout, data.heldout_observed
    heldout = Rows(v, label, observed)
    if data.replicas:
        train, heldout = (
            Rows(*(x if x is None or x.shape[0] != data.replicas[0] else x[run.replica] for x in part))  # type: ignore[arg-type]
            if part.label.ndim > 1
            else part
            for part in (train, heldout)
        )
    return TrainingRows(_kept(run, train, most), _kept(run, heldout, most))


def _kept(run: Run, rows: Rows, most: int) -> Rows:
    """Values of the units as numbers of the sites, of every k-th row."""
    units, step = visible_of(run), -(-rows.n // most)
    v, label, observed, weight = (None if x is None else x[::step] for x in rows)
    assert v is not None
    assert label is not None
    of_images = run.needed_schema.units() is None
    numbers = units.to_intensity(v) if of_images else units.decode(v)
    known = None if observed is None else units.site_sums(observed.to(v)) > 0
    return Rows(numbers.to(v), label.new_full(label.shape, UNLABELLED), known, weight)


def _from_folder(source: Any, name: str, folder: Path) -> Any:
    """Settings of a source whose relative paths start in another folder."""
    if isinstance(source, dict):
        return {key: _from_folder(value, f"{name}.{key}", folder) for key, value in source.items()}
    relative = isinstance(source, str) and is_path(name) and not source.startswith("~")
    return str(folder / source) if relative else source
