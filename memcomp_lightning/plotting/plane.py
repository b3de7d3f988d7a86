"""Where data and samples lie in the plane in which the data vary most."""

from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.ndimage import gaussian_filter

from memcomp_lightning.errors import require
from memcomp_lightning.plotting.points import Numbers, Points

_MAPS = {"data": "Blues", "samples": "Oranges", "held-out data": "Greens"}
_N_BINS = 80
_NARROWEST = 1.0
"""Places that a row is spread over at least, of those along an axis."""
_FAINTEST = 0.004
"""Densities below this share of the highest are left white."""
_HELD = (0.5, 0.9)
"""Shares of the data within the lines."""


class Plane(NamedTuple):
    """Where rows are drawn.

    Attributes:
        mean: Of the data, ``(n_entries,)``.
        directions: The two in which the data vary most, ``(2, n_entries)``.
        shares: Of the variance of the data, ``(2,)``.
    """

    mean: Numbers
    directions: Numbers
    shares: Numbers


def plot_plane(data: Points, samples: Points, heldout: Points | None = None) -> Figure:
    """Densities on the first two principal components of the data: a panel each of data, samples, held-out data.

    Lines hold the densest 50 % and 90 % of the data; they are the same in all panels. A missing value is put at
    the mean of the data. Sample k loses what row k of the data lacks, so that both are drawn alike.

    Args:
        data: Rows of the data.
        samples: Rows of samples, of the same entries.
        heldout: Rows that were not trained on, of the same entries.

    Raises:
        SettingError: There are no two entries.
    """
    require(data.x.shape[1] >= 2, "number of entries", data.x.shape[1], "two or more, for a plane")
    plane = principal_plane(data)
    missing = np.isnan(data.x)[np.arange(len(samples.x)) % len(data.x)]
    alike = Points(np.where(missing, np.nan, samples.x), samples.weight)
    sets = {"data": data, "samples": alike} | ({} if heldout is None else {"held-out data": heldout})
    places = {name: _filled(points, plane.mean) @ plane.directions.T for name, points in sets.items()}
    edges = [_edges([place[:, axis] for place in places.values()]) for axis in (0, 1)]
    widths = [_width(place, edge) for place, edge in zip(places["data"].T, edges, strict=True)]
    densities = {name: _density(places[name], points.weights, edges, widths) for name, points in sets.items()}
    top = max(float(density.max()) for density in densities.values())
    levels = _levels(densities["data"])
    figure = Figure(figsize=(2.7 * len(sets) + 0.3, 2.9), layout="constrained")
    panels = figure.subplots(1, len(sets), sharex=True, sharey=True, squeeze=False)[0]
    for axes, (name, density) in zip(panels, densities.items(), strict=True):
        norm = PowerNorm(0.5, vmin=0.0, vmax=top)
        visible = np.ma.masked_less(density.T, _FAINTEST * top)
        axes.pcolormesh(*edges, visible, cmap=_MAPS[name], norm=norm, rasterized=True)
        _draw_lines(axes, edges, densities["data"], levels)
        axes.set_title(name, fontsize="small", loc="left")
        axes.tick_params(labelsize="x-small")
        axes.spines[["top", "right"]].set_visible(False)
    first = f"first principal component of the data ({plane.shares[0]:.0%} of the variance)"
    figure.supxlabel(first, fontsize="small")
    panels[0].set_ylabel(f"second ({plane.shares[1]:.0%})", fontsize="small")
    return figure


def principal_plane(data: Points) -> Plane:
    """The two directions in which the data vary most, each with its largest entry positive."""
    mean = data.means()
    x = _filled(data, mean)
    weight = data.weights[:, None] / data.weights.sum()
    n = x.shape[1]
    covariance = (weight * x).T @ x
    variances, vectors = eigh(covariance, subset_by_index=(n - 2, n - 1))
    found = vectors.T[::-1]
    found = found * np.sign(found[np.arange(2), np.abs(found).argmax(1)])[:, None]
    total = max(float(np.trace(covariance)), np.finfo(np.float64).tiny)
    return Plane(mean, found, np.maximum(variances[::-1], 0.0) / total)


def _filled(points: Points, mean: Numbers) -> Numbers:
    """Differences from the mean, 0 where a value is missing."""
    return np.where(np.isnan(points.x), 0.0, np.asarray(points.x, dtype=np.float64) - mean)


def _edges(places: list[Numbers]) -> Numbers:
    """Bins over the middle 99.8 % of each set, and some room."""
    ends = [np.quantile(place, (0.001, 0.999)) for place in places]
    low, high = min(float(end[0]) for end in ends), max(float(end[1]) for end in ends)
    room = 0.08 * (high - low) or 0.5
    return np.linspace(low - room, high + room, _N_BINS + 1)


def _width(place: Numbers, edges: Numbers) -> float:
    """Half the width of Scott's rule (1992), in bins: clusters stay apart."""
    scott = float(place.std()) * float(np.power(len(place), -1 / 6))
    return max(_NARROWEST, 0.5 * scott / float(edges[1] - edges[0]))


def _density(places: Numbers, weight: Numbers, edges: list[Numbers], widths: list[float]) -> Numbers:
    """Share of the rows by place, spread over the neighbours, ``(n_bins, n_bins)``."""
    counts = np.histogram2d(places[:, 0], places[:, 1], bins=edges, weights=weight)[0]
    found: Numbers = gaussian_filter(counts / weight.sum(), widths, mode="constant")
    return found


def _levels(density: Numbers) -> list[float]:
    """Densities above which the shares of the data lie, rising."""
    falling = np.sort(density.ravel())[::-1]
    below = np.cumsum(falling) / max(float(falling.sum()), np.finfo(np.float64).tiny)
    found = {float(falling[min(int(np.searchsorted(below, share)), len(falling) - 1)]) for share in _HELD}
    return sorted(level for level in found if level > 0)


def _draw_lines(axes: Axes, edges: list[Numbers], density: Numbers, levels: list[float]) -> None:
    if levels:
        middles: list[NDArray[np.float64]] = [(edge[1:] + edge[:-1]) / 2 for edge in edges]
        axes.contour(*middles, density.T, levels=levels, colors="0.15", linewidths=0.8)
