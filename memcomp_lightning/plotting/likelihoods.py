"""How likely rows are under a model: training and held-out data, and samples."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.plotting.histograms import COLOURS, plot_histograms


def plot_likelihoods(
    values: Mapping[str, NDArray[np.floating]],
    *,
    weights: Mapping[str, NDArray[np.floating]] | None = None,
    xlabel: str = "log-likelihood (nats)",
    n_bins: int = 40,
) -> Figure:
    """Histograms of one number a row, for several sets of rows on one axis, with their means as dashed lines.

    A model that is right gives its samples what it gives held-out data. Samples that are likelier than the data
    betray chains in a few deep modes, or a model that spreads too little; training data that are likelier than
    held-out ones betray overfitting. The bins reach over the middle 99 % of each set.

    Args:
        values: Log-likelihoods or free energies by the name of the set, ``(n,)`` each, at most four sets; what is
            not finite is left out.
        weights: How often each row counts, by name; a set that is not named counts each row once.
        xlabel: Name of the number.
        n_bins: Bins, >= 1.

    Raises:
        SettingError: No set with a finite number, or too many.
    """
    require_count("n_bins", n_bins)
    finite = {name: np.isfinite(own) for name, own in values.items()}
    known = {name: np.asarray(own, dtype=np.float64)[finite[name]] for name, own in values.items()}
    known = {name: own for name, own in known.items() if len(own)}
    allowed = f"1 to {len(COLOURS)} sets with a finite number"
    require(1 <= len(known) <= len(COLOURS), "values", sorted(values), allowed)
    given = {name: np.asarray(own, dtype=np.float64)[finite[name]] for name, own in (weights or {}).items()}
    counts = {name: given.get(name, np.ones(len(own))) for name, own in known.items()}
    # Of few rows, too, the ends are rows.
    low = min(float(np.quantile(own, 0.005, method="lower")) for own in known.values())
    high = max(float(np.quantile(own, 0.995, method="higher")) for own in known.values())
    edges = np.linspace(low, high if high > low else low + 1, n_bins + 1)
    means = {name: float(np.average(own, weights=counts[name])) for name, own in known.items()}
    shown = {
        f"{name}, mean {means[name]:.4g}": np.histogram(own, edges, weights=counts[name])[0]
        for name, own in known.items()
    }
    figure = plot_histograms(edges, shown, xlabel=xlabel)
    (axes,) = figure.axes
    for colour, mean in zip(COLOURS, means.values(), strict=False):
        if edges[0] <= mean <= edges[-1]:
            axes.axvline(mean, color=colour, linewidth=1.0, linestyle="--")
    # Above the curves, which the lines of the means leave no room beside.
    figure.set_figheight(2.5 + 0.2 * len(shown))
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False, fontsize="small")
    return figure
