"""Histograms of one quantity on top of each other."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning.errors import require
from memcomp_lightning.plotting.style import DATA, FOURTH, HELDOUT, SAMPLES

COLOURS = (DATA, SAMPLES, HELDOUT, FOURTH)


def plot_histograms(
    edges: NDArray[np.floating], counts: Mapping[str, NDArray[np.floating]], *, xlabel: str = ""
) -> Figure:
    """Shares of values by bin, a filled step curve for each name; a figure that pyplot does not know.

    Args:
        edges: ``(n_bins + 1,)``, rising.
        counts: Counts or weights of each bin by name, ``(n_bins,)`` each, at most four names; each set is drawn
            as shares of its sum.
        xlabel: Name of the quantity.
    """
    allowed = f"1 to {len(COLOURS)} sets of counts"
    require(1 <= len(counts) <= len(COLOURS), "counts", sorted(counts), allowed)
    figure = Figure(figsize=(4.2, 2.6), layout="constrained")
    axes = figure.add_subplot()
    for colour, (name, values) in zip(COLOURS, counts.items(), strict=False):
        axes.stairs(values / values.sum(), edges, fill=True, color=colour, alpha=0.35)
        axes.stairs(values / values.sum(), edges, color=colour, linewidth=1.1, label=name)
    axes.set(xlabel=xlabel, ylabel="share")
    axes.set_ylim(bottom=0)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize="small")
    return figure
