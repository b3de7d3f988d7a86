"""How values of real units are distributed, in data and in samples."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning.plotting.style import DATA, SAMPLES


def plot_densities(
    data: NDArray[np.floating], samples: NDArray[np.floating], names: Sequence[str], *, n_bins: int = 30
) -> Figure:
    """A panel for each unit: data as a filled histogram, samples as a line on the same bins, as densities.

    The bins reach over the middle 99 % of data and samples, so that a few stray values do not hide the rest.

    Args:
        data: ``(n, n_units)``; NaN is missing.
        samples: ``(n_samples, n_units)``.
        names: Of the units.
        n_bins: Of each panel, >= 1.
    """
    n_units = data.shape[1]
    n_columns = min(3, n_units)
    n_rows = math.ceil(n_units / n_columns)
    figure = Figure(figsize=(2.3 * n_columns + 0.4, 1.7 * n_rows + 0.4), layout="constrained")
    panels = figure.subplots(n_rows, n_columns, squeeze=False).ravel()
    for axes, name, own, drawn in zip(panels, names, data.T, samples.T, strict=False):
        draw_densities(axes, own, drawn, n_bins=n_bins)
        axes.set_title(name, fontsize="small", loc="left")
    for axes in panels[n_units:]:
        axes.set_axis_off()
    panels[0].legend(frameon=False, fontsize="x-small")
    figure.supylabel("density", fontsize="small")
    return figure


def draw_densities(
    axes: Axes,
    data: NDArray[np.floating],
    samples: NDArray[np.floating],
    *,
    weight: NDArray[np.floating] | None = None,
    n_bins: int = 30,
) -> None:
    """One panel: both as densities on the same bins, of whole numbers as many to a bin.

    Args:
        axes: The panel.
        data: ``(n,)``; NaN is missing.
        samples: ``(n_samples,)``.
        weight: How often each value of the data counts, ``(n,)``; None is once.
        n_bins: Of the panel, >= 1.
    """
    weights = np.ones(len(data)) if weight is None else weight
    known, drawn = np.isfinite(data), samples[np.isfinite(samples)]
    edges = _edges(data[known], drawn, n_bins)
    sets = ((data[known], weights[known], DATA, "data"), (drawn, np.ones(len(drawn)), SAMPLES, "samples"))
    for values, counts, colour, label in sets:
        # Of all values, so that what lies outside the bins does not make the rest look higher.
        total = counts.sum() if len(counts) else 1.0
        density = np.histogram(values, edges, weights=counts)[0] / total / (edges[1] - edges[0])
        axes.stairs(density, edges, fill=label == "data", color=colour, alpha=0.35 if label == "data" else 1)
        axes.stairs(density, edges, color=colour, linewidth=1.1, label=label)
    axes.set_ylim(bottom=0)
    axes.locator_params(axis="x", nbins=5)
    axes.tick_params(labelsize="x-small")
    axes.yaxis.get_offset_text().set_fontsize("x-small")
    axes.spines[["top", "right"]].set_visible(False)


def _edges(data: NDArray[np.floating], samples: NDArray[np.floating], n_bins: int) -> NDArray[np.floating]:
    """Bins over the middle 99 % of both."""
    sets = [values for values in (data, samples) if len(values)]
    ends = [np.quantile(values, (0.005, 0.995)) for values in sets] or [np.array((0.0, 1.0))]
    low, high = min(float(end[0]) for end in ends), max(float(end[1]) for end in ends)
    if all((values == np.round(values)).all() for values in sets):
        # Bins of unequal numbers of whole numbers would look like a comb.
        low, high = math.floor(low), math.ceil(high)
        width = math.ceil((high - low + 1) / n_bins)
        return np.arange(low, high + width + 1, width) - 0.5
    return np.linspace(low, high if high > low else low + 1, n_bins + 1)
