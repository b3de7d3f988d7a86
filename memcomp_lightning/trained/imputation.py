"""What is missing of rows: its distribution given what is known, and completed rows."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import Columns, Schema
from memcomp_lightning.errors import require_count
from memcomp_lightning.likelihood.layers import NUMBERS
from memcomp_lightning.likelihood.missing import MissingChains, finders
from memcomp_lightning.models.sites import sites_of
from memcomp_lightning.trained.gaps import Reading, SiteGaps, joined
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.values import values, visible_of

MOST_ROWS = 4096
"""Rows that are completed together at most."""


@dataclass(frozen=True, eq=False)
class Imputation:
    """Rows, and what is missing of them.

    Attributes:
        rows: As they were given.
        gaps: What is missing, by site; sites without gaps are left out.
        r_hat: Split R-hat of the chains of each row; NaN where exact sums were taken, and of rows without gaps.
        m: Number of draws.
    """

    rows: Rows
    gaps: tuple[SiteGaps, ...]
    r_hat: Tensor
    m: int

    @property
    def n_gaps(self) -> int:
        """Number of values that are missing."""
        return sum(len(gaps.row) for gaps in self.gaps)

    @property
    def mean_probability(self) -> float:
        """Mean stated probability of the values of discrete sites that are filled in: the share that is right.

        NaN if there are none.
        """
        found = torch.cat([torch.zeros(0), *(gaps.of_value for gaps in self.gaps)])
        return float(found.nanmean())

    def completed(self, draw: int | None = None) -> Tensor:
        """Numbers of the sites with the gaps filled, ``(n, n_sites)``.

        Args:
            draw: One of the draws, from 0; None is the likeliest values and the means.
        """
        v = self.rows.v.clone()
        for gaps in self.gaps:
            v[gaps.row, gaps.site] = gaps.value if draw is None else gaps.draws[draw]
        return v


@torch.no_grad()
def impute(
    run: Run, rows: Rows, *, m: int | None = None, seed: int = 0, chains: MissingChains | None = None
) -> Imputation:
    r"""Find the distribution of everything that is missing, given what is known of its row.

    Exact where the hidden states can be summed (up to 12 hidden bits) or, in an RBM, the missing values (up to
    2^10 states a row, none of them real); by clamped Gibbs chains otherwise, whose agreement is measured.

    Args:
        run: A trained run.
        rows: With gaps of any pattern, whole rows too.
        m: Draws of all that is missing, >= 1; None draws nothing. The model is taken as it is: draws vary as its
            rows do, not as models of other training rows would.
        seed: Of chains and draws.
        chains: Settings of the chains.

    Raises:
        UserError, SettingError: The run has no energy model; a value that the units do not take; m < 1.
    """
    if m is not None:
        require_count("m", m)
    v, observed = values(run, rows)
    model, units, n = run.model, visible_of(run), m or 0
    r_hat = torch.full((len(v),), torch.nan)
    if observed is None:
        return Imputation(rows, (), r_hat, n)
    units.check(v, observed)
    generator = rng.stream(seed, "imputation")
    reading = Reading.of(run.needed_schema, units)
    parts: list[dict[int, SiteGaps]] = []
    for finder, numbers in finders(model, observed, chains):
        at_once = max(1, min(MOST_ROWS, NUMBERS // finder.numbers_a_row(model, n)))
        for some in numbers.split(at_once):
            found = finder.find(model, v[some], observed[some], m=n, generator=generator)
            r_hat[some] = found.r_hat.to(r_hat)
            parts.append(dict(reading.gaps(some, observed[some], found)))
    sites = sorted({site for part in parts for site in part})
    return Imputation(
        rows, tuple(joined([part[site] for part in parts if site in part]) for site in sites), r_hat, n
    )


def completed_columns(schema: Schema, path: Path, v: Tensor) -> Columns:
    """Completed rows in the user's columns: all those of the file, where the kind of data can give them.

    Args:
        schema: Of the run.
        path: The file that was read.
        v: Numbers of the sites, ``(n, n_sites)``.
    """
    filled = getattr(schema, "filled", None)
    found: Columns = schema.decode(v) if filled is None else filled(path, v)
    return found


def gap_columns(schema: Schema, found: Imputation) -> Columns:
    """One row for each gap, in the user's words: ``row`` (from 1), ``column``, ``value`` and how sure it is.

    ``probability`` is that of a discrete value; ``deviation``, ``low`` and ``high`` are the standard deviation of
    a real value and the interval that holds it with 90 %. The others are NaN.
    """
    scales = np.exp(getattr(schema, "log_scales", np.zeros(schema.n_sites)))
    v, parts = found.completed(), [_of_gaps(0)]
    for gaps in found.gaps:
        own, part = v[gaps.row], _of_gaps(len(gaps.row))
        part["row"], part["column"][:] = gaps.row.numpy() + 1, schema.site_names[gaps.site]
        part["value"][:] = [_text(cell) for cell in _words(schema, own, gaps.site, gaps.value)]
        part["probability"] = gaps.of_value.double().numpy()
        if gaps.deviation is not None and gaps.low is not None and gaps.high is not None:
            part["deviation"] = gaps.deviation.double().numpy() * scales[gaps.site]
            for name, end in (("low", gaps.low), ("high", gaps.high)):
                part[name][:] = _words(schema, own, gaps.site, end)
        parts.append(part)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    order = np.argsort(columns["row"], kind="stable")
    return {name: column[order] for name, column in columns.items()}


def _of_gaps(n: int) -> Columns:
    """The columns of n gaps, with nothing in them yet."""
    words: Columns = {name: np.full(n, "", dtype=object) for name in ("column", "value")}
    numbers = {name: np.full(n, np.nan) for name in ("probability", "deviation", "low", "high")}
    return {"row": np.zeros(n, dtype=np.int64), **words, **numbers}


def _text(cell: Any) -> str:
    return f"{cell:.7g}" if isinstance(cell, float) else str(cell)


def _words(schema: Schema, rows: Tensor, site: int, numbers: Tensor) -> list[Any]:
    """Numbers of a site in the user's words; letters of a sequence are no columns, but have names as entries."""
    rows, name = rows.clone(), schema.site_names[site]
    rows[:, site] = numbers
    columns = schema.decode(rows)
    if name in columns:
        return list(columns[name].tolist())
    units = schema.units()
    assert units is not None
    entries = sites_of(units)[site].entries
    return [schema.entry_names[entries[int(number)]].removeprefix(f"{name}=") for number in numbers.tolist()]
