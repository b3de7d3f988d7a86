"""How the values of each column are distributed, in data and in samples."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.plotting.densities import draw_densities
from memcomp_lightning.plotting.style import DATA, SAMPLES, shortened

Cells = NDArray[Any]
"""One column; NaN and None are empty."""

_MOST_VALUES = 12
"""Numbers of so few different values are drawn as categories."""
_MOST_LETTERS, _MOST_WORDS = 24, 12
"""Bars of a panel."""
_LONGEST = 12


def plot_marginals(
    data: Mapping[str, Cells],
    samples: Mapping[str, Cells],
    *,
    weight: NDArray[np.floating] | None = None,
    n_panels: int = 12,
) -> Figure:
    """A panel for each column: bars of the shares of words, densities of numbers, of data and of samples.

    The number beside the name says how far both are apart: of words the total variation, half the sum of the
    differences of the shares; of numbers the largest difference of the cumulative shares (Kolmogorov and Smirnov).
    Both lie between 0 and 1. Where there are more columns than panels, those that are furthest apart are drawn.

    Args:
        data: Columns by name, ``(n,)`` each; texts, or numbers. Numbers of up to 12 different values are words.
        samples: Columns of the same names, ``(n_samples,)`` each. Columns that data or samples lack are left out.
        weight: How often each row of the data counts, ``(n,)``; None is once.
        n_panels: Most columns to draw, >= 1.

    Raises:
        SettingError: Data and samples have no column in common, or none with a value.
    """
    require_count("n_panels", n_panels)
    found = [_Column(name, data[name], samples[name], weight) for name in data if name in samples]
    known = [column for column in found if column.known]
    require(bool(known), "columns", list(data)[:6], "one or more that samples have, too, with a value in it")
    chosen = sorted(known, key=lambda column: -column.distance)[:n_panels]
    n_columns = min(4, len(chosen))
    n_rows = math.ceil(len(chosen) / n_columns)
    size = (max(2.3 * n_columns + 0.3, 3.4), 1.75 * n_rows + 0.45)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes, column in zip(panels, chosen, strict=False):
        column.draw(axes)
        axes.set_title(f"{shortened(column.name, 16)} ({column.distance:.2f} apart)", fontsize="small", loc="left")
    for axes in panels[len(chosen) :]:
        axes.set_axis_off()
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper right", ncols=2, frameon=False, fontsize="small")
    if len(chosen) < len(known):
        title = f"the {len(chosen)} columns that differ most, of {len(known)}"
        figure.suptitle(title, x=0.01, ha="left", fontsize="small")
    figure.supylabel("share, or density", fontsize="small")
    return figure


class _Column:
    """The values of one column that are known."""

    def __init__(self, name: str, data: Cells, samples: Cells, weight: NDArray[np.floating] | None) -> None:
        self.name = name
        known, drawn = ~_empty(data), ~_empty(samples)
        self.data, self.samples = data[known], samples[drawn]
        self.weight = np.ones(len(self.data)) if weight is None else np.asarray(weight, dtype=np.float64)[known]
        self.known = bool(len(self.data) and len(self.samples))
        if not self.known:
            return
        values, at = np.unique(_plain(np.concatenate((self.data, self.samples))), return_inverse=True)
        n = len(values)
        of_data = np.bincount(at[: len(self.data)], self.weight, minlength=n) / self.weight.sum()
        of_samples = np.bincount(at[len(self.data) :], minlength=n) / len(self.samples)
        self.values, self.shares = values, np.stack((of_data, of_samples))
        self.words = n <= _MOST_VALUES or not np.issubdtype(values.dtype, np.number)
        gap = of_data - of_samples
        self.distance = float(np.abs(gap).sum() / 2 if self.words else np.abs(np.cumsum(gap)).max())

    def draw(self, axes: Axes) -> None:
        """One panel."""
        if self.words:
            _draw_bars(axes, self.values, self.shares)
        else:
            draw_densities(axes, self.data.astype(np.float64), self.samples.astype(np.float64), weight=self.weight)


def _draw_bars(axes: Axes, values: Cells, shares: NDArray[np.float64]) -> None:
    """Bars side by side, the most frequent words where there are too many."""
    texts = [f"{value:g}" if isinstance(value, float) else str(value) for value in values.tolist()]
    labels = [shortened(text, _LONGEST) for text in texts]
    most = _MOST_LETTERS if max(map(len, labels)) <= 2 else _MOST_WORDS
    if len(values) > most:
        kept = np.sort(np.argsort(-shares.sum(0), kind="stable")[: most - 1])
        rest = 1 - shares[:, kept].sum(1, keepdims=True)
        shares, labels = np.hstack((shares[:, kept], rest)), [*(labels[k] for k in kept), "others"]
    at = np.arange(len(labels))
    for share, shift, colour, label in zip(shares, (-0.2, 0.2), (DATA, SAMPLES), ("data", "samples"), strict=True):
        axes.bar(at + shift, share, width=0.4, color=colour, label=label)
    upright = sum(map(len, labels)) + len(labels) <= 26
    small = "x-small" if len(labels) <= 12 else 5.5
    axes.set_xticks(at, labels, rotation=0 if upright or max(map(len, labels)) == 1 else 90, fontsize=small)
    axes.tick_params(axis="y", labelsize="x-small")
    axes.tick_params(axis="x", length=0)
    axes.spines[["top", "right"]].set_visible(False)


def _empty(cells: Cells) -> NDArray[np.bool_]:
    """Which cells are empty."""
    if cells.dtype == object:
        return np.array([cell is None or cell != cell for cell in cells.tolist()], dtype=bool)
    if np.issubdtype(cells.dtype, np.floating):
        return ~np.isfinite(cells)
    return np.zeros(len(cells), dtype=bool)


def _plain(cells: Cells) -> Cells:
    """Cells that can be sorted: numbers, or texts."""
    if cells.dtype != object:
        return cells
    return np.array([str(cell) for cell in cells.tolist()])
