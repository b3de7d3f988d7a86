"""How often each state stands at each site, in data and in samples."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning.plotting.alphabet import LETTERS, letters_of

Table = NDArray[np.floating]
"""One number for each site and state, ``(n_sites, q)``; NaN where a site has fewer states."""


def plot_state_frequencies(data: Table, samples: Table, *, alphabet: str | None = None, title: str = "") -> Figure:
    """Frequencies of data, of samples, and their difference, as heat maps of site and state on top of each other.

    Args:
        data: Shares, ``(n_sites, q)``, of each site adding up to 1; NaN where a site has fewer states.
        samples: The same of samples.
        alphabet: Letters of the states; None takes digits and then capitals.
        title: Printed above.
    """
    n_sites, q = data.shape
    height = max(0.9, min(0.16 * q, 2.6))
    figure = Figure(figsize=(max(4.2, min(0.14 * n_sites + 1.6, 11)), 3 * height + 0.9), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    difference = samples - data
    largest = max(float(np.nanmax(np.abs(difference), initial=0.0)), 1e-3)
    for axes, name, table in zip(
        panels, ("data", "samples", "difference"), (data, samples, difference), strict=True
    ):
        signed = name == "difference"
        limits = {"vmin": -largest, "vmax": largest} if signed else {"vmin": 0.0, "vmax": 1.0}
        image = axes.imshow(table.T, aspect="auto", cmap="RdBu_r" if signed else "viridis", **limits)
        axes.set_ylabel(name)
        axes.set_facecolor("0.75")  # states that a site does not have
        label_states(axes, q, alphabet)
        figure.colorbar(image, ax=axes, fraction=0.05, pad=0.01)
    panels[-1].set_xlabel("site")
    if title:
        panels[0].set_title(title, fontsize="medium", loc="left")
    return figure


def label_states(axes: Axes, q: int, alphabet: str | None) -> None:
    """The letters of the states at the vertical axis; a few numbers where there are more states than letters."""
    if alphabet is None and q > len(LETTERS):
        return
    axes.set_yticks(range(q), list(letters_of(q, alphabet)), fontsize=5 if q > 8 else 7)
    axes.tick_params(axis="y", length=0)
