"""How well missing values are found: cells that were masked, against what was found for them."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning.errors import require
from memcomp_lightning.plotting.style import DATA, SAMPLES, shortened

Numbers = NDArray[np.floating]

_MOST_MARKS = 400
_N_BINS = 10


class RealCells(NamedTuple):
    """Cells of a real column that were masked.

    Attributes:
        truth: What they were, ``(n,)``.
        mean: What was expected.
        low: Lower end of its 90 % interval.
        high: Upper end.
    """

    truth: Numbers
    mean: Numbers
    low: Numbers
    high: Numbers

    @property
    def coverage(self) -> float:
        """Share of the cells that lie in their interval; 0.9 is right."""
        return float(np.mean((self.low <= self.truth) & (self.truth <= self.high)))


class DiscreteCells(NamedTuple):
    """States that masked cells could have had.

    Attributes:
        probability: Of the state, ``(n,)``.
        outcome: 1 where the cell had it, and 0 where not.
    """

    probability: Numbers
    outcome: Numbers


def plot_imputation(real: Mapping[str, RealCells], discrete: DiscreteCells | None = None) -> Figure:
    """A panel for each real column, means with 90 % intervals against true values; one of calibration.

    The calibration curve shows how often a state was the true one, against the probability that it was given; bars
    are 95 % intervals by Wilson, the steps below show how often each probability was given.

    Args:
        real: Real columns by name, at most 400 evenly spaced cells of each are drawn; columns without cells are
            left out.
        discrete: All states of all discrete cells together; None without any.

    Raises:
        SettingError: There is no cell.
    """
    columns = {name: cells for name, cells in real.items() if len(cells.truth)}
    calibrated = discrete is not None and len(discrete.probability) > 0
    n_panels = len(columns) + calibrated
    require(n_panels > 0, "masked cells", 0, "one or more")
    n_columns = min(4, n_panels)
    n_rows = math.ceil(n_panels / n_columns)
    figure = Figure(figsize=(2.6 * n_columns + 0.2, 2.5 * n_rows + 0.1), layout="constrained")
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes, (name, cells) in zip(panels, columns.items(), strict=False):
        _draw_real(axes, cells)
        axes.set_title(f"{shortened(name, 18)}: {cells.coverage:.0%} within", fontsize="small", loc="left")
    if discrete is not None and calibrated:
        _draw_calibration(panels[len(columns)], discrete)
    for axes in panels[n_panels:]:
        axes.set_axis_off()
    for axes in panels[:n_panels]:
        axes.tick_params(labelsize="x-small")
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def calibration(cells: DiscreteCells, n_bins: int = _N_BINS) -> NDArray[np.float64]:
    """Mean probability, share of true ones and number of cells of each bin of probabilities, ``(3, n_filled)``."""
    at = np.minimum((np.asarray(cells.probability) * n_bins).astype(np.int64), n_bins - 1)
    count = np.bincount(at, minlength=n_bins)
    filled = count > 0
    sums = [np.bincount(at, x, minlength=n_bins)[filled] for x in (cells.probability, cells.outcome)]
    found: NDArray[np.float64] = np.stack((*(total / count[filled] for total in sums), count[filled]))
    return found


def _draw_real(axes: Axes, cells: RealCells) -> None:
    """Means with intervals, and the diagonal."""
    some = slice(None, None, -(-len(cells.truth) // _MOST_MARKS))
    truth, mean, low, high = (np.asarray(x, dtype=np.float64)[some] for x in cells)
    axes.axline((float(truth[0]),) * 2, slope=1, color="0.6", linewidth=0.8, zorder=0)
    axes.vlines(truth, low, high, color=DATA, linewidth=0.6, alpha=0.35)
    axes.scatter(truth, mean, s=6, color=DATA, linewidth=0)
    axes.set_xlabel("true value", fontsize="small")
    axes.set_ylabel("mean, 90 % interval", fontsize="small")


def _draw_calibration(axes: Axes, cells: DiscreteCells) -> None:
    """The curve, and how often each probability was given."""
    p, share, count = calibration(cells)
    low, high = _wilson(share, count)
    axes.axline((0, 0), slope=1, color="0.6", linewidth=0.8, zorder=0)
    all_counts = np.histogram(cells.probability, _N_BINS, (0, 1))[0]
    edges = np.linspace(0, 1, _N_BINS + 1)
    axes.stairs(0.25 * all_counts / all_counts.max(), edges, fill=True, color="0.85", zorder=0)
    axes.errorbar(p, share, (share - low, high - share), fmt="o-", markersize=3, linewidth=0.9, color=SAMPLES)
    off = float((np.abs(p - share) * count).sum() / count.sum())
    axes.set_title(f"states: {off:.3f} off", fontsize="small", loc="left")
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02))
    axes.set_xlabel("probability", fontsize="small")
    axes.set_ylabel("share that was true", fontsize="small")


def _wilson(share: Numbers, count: Numbers, z: float = 1.96) -> tuple[Numbers, Numbers]:
    """Ends of the 95 % interval of a share (Wilson 1927)."""
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(share * (1 - share) / count + (z / (2 * count)) ** 2)
    return np.minimum(middle - half, share), np.maximum(middle + half, share)
