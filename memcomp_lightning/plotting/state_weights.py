"""What hidden units prefer at each site of categories."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning.plotting.state_frequencies import label_states


def plot_state_weights(
    weights: NDArray[np.floating], names: Sequence[str], *, alphabet: str | None = None
) -> Figure:
    """Weights of a few hidden units as heat maps of site and state, one below the other, on one scale.

    Args:
        weights: ``(n_units, n_sites, q)``; NaN where a site has fewer states.
        names: Of the units.
        alphabet: Letters of the states; None takes digits and then capitals.
    """
    n_units, n_sites, q = weights.shape
    height, width = max(0.7, min(0.11 * q, 2.2)), max(4.2, min(0.14 * n_sites + 1.6, 11))
    figure = Figure(figsize=(width, n_units * height + 0.6), layout="constrained")
    panels = figure.subplots(n_units, 1, sharex=True, squeeze=False)[:, 0]
    largest = max(float(np.nanmax(np.abs(weights), initial=0.0)), 1e-6)
    for axes, name, table in zip(panels, names, weights, strict=True):
        image = axes.imshow(table.T, aspect="auto", cmap="RdBu_r", vmin=-largest, vmax=largest)
        axes.set_ylabel(name, fontsize="small")
        axes.set_facecolor("0.75")  # states that a site does not have
        label_states(axes, q, alphabet)
    panels[-1].set_xlabel("site")
    figure.colorbar(image, ax=list(panels), fraction=0.03, pad=0.01, label="weight")
    return figure
