"""How values of real units are distributed, in data and in samples."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

_DATA, _SAMPLES = "#0072B2", "#D55E00"


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
        own, drawn = (values[np.isfinite(values)] for values in (own, drawn))
        ends = [np.quantile(values, (0.005, 0.995)) for values in (own, drawn) if len(values)] or [(0.0, 1.0)]
        low, high = min(end[0] for end in ends), max(end[1] for end in ends)
        edges = np.linspace(low, high if high > low else low + 1, n_bins + 1)
        for values, colour, label in ((own, _DATA, "data"), (drawn, _SAMPLES, "samples")):
            # Of all values, so that what lies outside the bins does not make the rest look higher.
            density = np.histogram(values, edges)[0] / max(len(values), 1) / (edges[1] - edges[0])
            axes.stairs(density, edges, fill=label == "data", color=colour, alpha=0.35 if label == "data" else 1)
            axes.stairs(density, edges, color=colour, linewidth=1.1, label=label)
        axes.set_title(name, fontsize="small", loc="left")
        axes.set_ylim(bottom=0)
        axes.tick_params(labelsize="x-small")
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[n_units:]:
        axes.set_axis_off()
    panels[0].legend(frameon=False, fontsize="x-small")
    figure.supylabel("density", fontsize="small")
    return figure
