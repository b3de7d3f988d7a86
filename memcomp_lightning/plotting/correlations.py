"""How pairs of entries go together, in samples against data."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.plotting.points import Numbers, Points
from memcomp_lightning.plotting.style import HELDOUT, SAMPLES, shortened

_MOST_MARKS = 3000
"""Of more pairs the picture shows how many lie where."""


class Agreement(NamedTuple):
    """How well numbers agree with those of the data.

    Attributes:
        r: Pearson's correlation; NaN where one side is constant.
        slope: Of the line of least squares; 1 is right, below 1 the correlations are too weak.
    """

    r: float
    slope: float


def plot_correlations(
    data: Points,
    samples: Points,
    heldout: Points | None = None,
    *,
    site: NDArray[np.integer] | None = None,
    names: Sequence[str] | None = None,
    most: int = 1000,
) -> Figure:
    r"""Connected correlations of each pair of entries, those of samples against those of the data.

    .. math:: C_{ij} = \langle x_i x_j \rangle - \langle x_i \rangle \langle x_j \rangle

    Of units in {0, 1} and of states of categories these are connected two-point frequencies. An entry with other
    values than -1, 0 and 1 is real, and is taken in standard deviations of the data. Pairs of one site are left
    out: its frequencies say what they are. Where values are missing, a pair is judged by the rows that have both.

    Held-out data against the data are the ceiling: no model comes closer to the diagonal, but by chance.

    Args:
        data: Rows of the data.
        samples: Rows of samples, of the same entries.
        heldout: Rows that were not trained on, of the same entries.
        site: The site of each entry, ``(n_entries,)``; None is one each.
        names: Of the entries: the pair that is furthest off is named.
        most: Most entries to compare, those of the largest variance in the data, >= 2.

    Raises:
        SettingError: There are no two sites.
    """
    require_count("most", most, minimum=2)
    n = data.x.shape[1]
    site = np.arange(n) if site is None else site
    scale = _scale(data)
    chosen = np.sort(np.argsort(-_variance(data) / scale**2, kind="stable")[:most])
    first, second = np.triu_indices(len(chosen), 1)
    apart = site[chosen][first] != site[chosen][second]
    first, second = first[apart], second[apart]
    require(len(first) > 0, "number of sites", len(np.unique(site)), "two or more, for pairs of them")

    def pairs_of(points: Points) -> Numbers:
        x = np.asarray(points.x, dtype=np.float64)[:, chosen] / scale[chosen]
        of_pairs: Numbers = covariances(Points(x, points.weight))[first, second]
        return of_pairs

    others = {"samples": samples} if heldout is None else {"samples": samples, "held-out data": heldout}
    of_data, found = pairs_of(data), {name: pairs_of(points) for name, points in others.items()}
    # The panels show the same pairs: what is not known on one side is left out everywhere.
    known = np.isfinite(of_data) & np.logical_and.reduce([np.isfinite(values) for values in found.values()])
    of_data, found = of_data[known], {name: values[known] for name, values in found.items()}
    limits = _limits(np.concatenate((of_data, *found.values())))
    figure = Figure(figsize=(3.3 * len(found) + 0.3, 3.4), layout="compressed")
    panels = figure.subplots(1, len(found), sharey=True, squeeze=False)[0]
    for axes, (name, values) in zip(panels, found.items(), strict=True):
        _draw(axes, of_data, values, limits, SAMPLES if name == "samples" else HELDOUT)
        fit = agreement(of_data, values)
        # 0.0 takes the sign from what is rounded to zero.
        r, slope = round(fit.r, 3) + 0.0, round(fit.slope, 2) + 0.0
        axes.set_title(f"{name}: r = {r:.3f}, slope {slope:.2f}", fontsize="small", loc="left")
        if names is not None and name == "samples" and len(values):
            worst = int(np.argmax(np.abs(values - of_data)))
            pair = [shortened(names[chosen[of_pair[known][worst]]], 22) for of_pair in (first, second)]
            text = "furthest off:\n" + "\n".join(pair)
            place = {"x": 0.98, "y": 0.02, "ha": "right", "va": "bottom", "transform": axes.transAxes}
            axes.text(s=text, fontsize="x-small", color="0.25", **place)
    figure.supxlabel(f"connected correlation in the data, {len(of_data):,} pairs", fontsize="small")
    panels[0].set_ylabel("connected correlation", fontsize="small")
    return figure


def covariances(points: Points) -> Numbers:
    """Weighted covariance of each pair over the rows that have both, ``(n_entries, n_entries)``, or NaN."""
    weight, known = points.weights[:, None], ~np.isnan(points.x)
    # About the means, so that no digits are lost.
    x = np.where(known, points.x - points.means(), 0.0)
    if known.all():
        x = x - (weight * x).sum(0) / weight.sum()
        complete: Numbers = (weight * x).T @ x / weight.sum()
        return complete
    total = (weight * known).T @ known.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (weight * x).T @ known / total
        found: Numbers = (weight * x).T @ x / total - mean * mean.T
    return found


def agreement(of_data: Numbers, values: Numbers) -> Agreement:
    """Pearson's r and the slope of the line through numbers against those of the data, ``(n_pairs,)`` each.

    >>> agreement(np.array([0.0, 1.0, 2.0]), np.array([1.0, 1.5, 2.0]))
    Agreement(r=1.0, slope=0.5)
    """
    if len(of_data) < 2:
        return Agreement(np.nan, np.nan)
    x, y = of_data - of_data.mean(), values - values.mean()
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    return Agreement(xy / (xx * yy) ** 0.5 if xx * yy > 0 else np.nan, xy / xx if xx > 0 else np.nan)


def _variance(points: Points) -> Numbers:
    known = ~np.isnan(points.x)
    square = np.where(known, points.x - points.means(), 0.0) ** 2
    found: Numbers = points.weights @ square / np.maximum(points.weights @ known, np.finfo(np.float64).tiny)
    return found


def _scale(data: Points) -> Numbers:
    """Standard deviations of real entries, 1 of the others."""
    deviation = np.sqrt(_variance(data))
    size = np.abs(data.x)
    discrete = ((size == 0) | (size == 1) | np.isnan(size)).all(0)
    return np.where(discrete | (deviation == 0), 1.0, deviation)


def _limits(values: Numbers) -> tuple[float, float]:
    """Of both axes: all values and zero, and some room."""
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    room = 0.06 * (high - low) or 1e-3
    return low - room, high + room


def _draw(axes: Axes, x: Numbers, y: Numbers, limits: tuple[float, float], colour: str) -> None:
    """Marks, or of many pairs how many lie where; the diagonal."""
    axes.axline((0, 0), slope=1, color="0.6", linewidth=0.8, zorder=0)
    if len(x) <= _MOST_MARKS:
        axes.scatter(x, y, s=9 if len(x) <= 300 else 4, color=colour, alpha=0.7, linewidth=0)
    else:
        look: dict[str, Any] = {"bins": "log", "cmap": "viridis", "mincnt": 1, "linewidths": 0.1}
        places = axes.hexbin(x, y, gridsize=55, extent=limits * 2, **look)
        bar = axes.figure.colorbar(places, ax=axes, fraction=0.046, pad=0.02)
        bar.ax.tick_params(labelsize="x-small")
        bar.set_label("pairs", fontsize="x-small")
    axes.set(xlim=limits, ylim=limits, aspect="equal")
    axes.tick_params(labelsize="x-small")
    axes.spines[["top", "right"]].set_visible(False)
