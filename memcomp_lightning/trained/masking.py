"""Values that are hidden on purpose, to see whether they are found."""

from collections.abc import Iterable
from typing import Protocol

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import Schema
from memcomp_lightning.errors import require
from memcomp_lightning.plotting.imputation import DiscreteCells, RealCells, plot_imputation


class Gaps(Protocol):
    """What was found for one site, in the rows where it is missing, in numbers as ``Rows.v`` has them."""

    @property
    def site(self) -> int:
        """Its number."""

    @property
    def row(self) -> Tensor:
        """Numbers of the rows, from 0, ``(n_gaps,)``."""

    @property
    def value(self) -> Tensor:
        """Of a real site the mean, ``(n_gaps,)``."""

    @property
    def states(self) -> Tensor | None:
        """What a discrete site may be, ``(n_states,)``; None of a real one."""

    @property
    def probability(self) -> Tensor | None:
        """That of each of these, ``(n_gaps, n_states)``."""

    @property
    def low(self) -> Tensor | None:
        """Where the interval begins that holds a real value with 90 %, ``(n_gaps,)``."""

    @property
    def high(self) -> Tensor | None:
        """Where it ends."""


def masked(rows: Rows, share: float = 0.1, *, seed: int = 0) -> Rows:
    """The rows with some of their known values hidden at random, to see whether they are found.

    Args:
        rows: With or without gaps.
        share: Of the known values that are hidden, in (0, 1).
        seed: Of the choice.
    """
    require(0 < share < 1, "share", share, "a number in (0, 1)")
    known = torch.ones_like(rows.v, dtype=torch.bool) if rows.observed is None else rows.observed
    hidden = rng.uniform(tuple(rows.v.shape), generator=rng.stream(seed, "masked")) < share
    return rows._replace(v=torch.where(hidden, 0.0, rows.v), observed=known & ~hidden)


def figure_of_imputation(schema: Schema, truth: Rows, gaps: Iterable[Gaps]) -> Figure:
    """What was found for hidden values against what they were: :func:`memcomp_lightning.plotting.plot_imputation`.

    Args:
        schema: Of the run.
        truth: The rows before values were hidden.
        gaps: What was found for each site, with those rows hidden by :func:`masked`; gaps that the rows had before
            are left out, as nobody knows what they were.

    Raises:
        SettingError: Nothing was hidden whose value is known.
    """
    real: dict[str, RealCells] = {}
    probability, outcome = [np.zeros(0)], [np.zeros(0)]
    for found in gaps:
        known = torch.ones_like(found.row, dtype=torch.bool)
        if truth.observed is not None:
            known = truth.observed[found.row, found.site]
        was = truth.v[found.row, found.site][known]
        if found.states is not None and found.probability is not None:
            states, p = found.states, found.probability[known]
            # A grey value between two states is partly both.
            hit = (1 - (was.unsqueeze(-1) - states).abs() / (states[1] - states[0]).abs()).clamp(min=0.0)
            one_of_two = slice(1, None) if len(states) == 2 else slice(None)
            probability.append(p[:, one_of_two].flatten().double().numpy())
            outcome.append(hit[:, one_of_two].flatten().double().numpy())
        elif found.low is not None and found.high is not None:
            of_cells = (was, found.value[known], found.low[known], found.high[known])
            real[schema.site_names[found.site]] = RealCells(
                *(_in_words(schema, found.site, numbers) for numbers in of_cells)
            )
    cells = DiscreteCells(np.concatenate(probability), np.concatenate(outcome))
    return plot_imputation(real, cells if len(cells.outcome) else None)


def _in_words(schema: Schema, site: int, numbers: Tensor) -> NDArray[np.float64]:
    """Numbers of a real site in the user's units."""
    rows = torch.full((len(numbers), schema.n_sites), torch.nan, device="cpu")
    rows[:, site] = numbers
    cells = schema.decode(rows)[schema.site_names[site]]
    return np.asarray(cells, dtype=np.float64)
