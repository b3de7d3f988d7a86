"""Rows as values of a model's visible units."""

from typing import cast

from omegaconf import OmegaConf
from torch import Tensor

from memcomp_lightning.configuration.networks import units_of_settings
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.errors import UserError
from memcomp_lightning.models import DBN, EnergyModel
from memcomp_lightning.models.units import Bernoulli, Units
from memcomp_lightning.trained.run import Run


def visible_of(run: Run) -> Units:
    """The visible units of a run: those of its model, or what a network without one is given."""
    network = run.network
    if isinstance(network, DBN):
        return network[0].visible
    if hasattr(network, "energy"):
        return cast(EnergyModel, network).visible
    schema = run.needed_schema
    if (units := schema.units()) is not None:
        return units
    if not run.settings:
        return Bernoulli(schema.n_sites)
    return units_of_settings(OmegaConf.create(dict(run.settings)), schema.n_sites)


def values(run: Run, rows: Rows) -> tuple[Tensor, Tensor | None]:
    """Values of the visible units, and where they are known; None is everywhere."""
    units = visible_of(run)
    kept = rows.v if run.needed_schema.units() is not None else units.from_intensity(rows.v)
    observed = None if rows.observed is None else units.over_sites(rows.observed)
    return units.encode(kept, check=False), observed


def complete_values(run: Run, rows: Rows) -> Tensor:
    """Values of the visible units of rows without gaps.

    Raises:
        UserError: A value is missing.
    """
    v, _ = values(run, rows)
    if rows.observed is not None and not bool(rows.observed.all()):
        row, site = (~rows.observed).nonzero()[0].tolist()
        name = run.needed_schema.site_names[site]
        raise UserError(f"row {row + 1}, column {name!r} is empty: fill it first, with memcomp-impute.")
    return v
