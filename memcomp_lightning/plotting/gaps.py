"""Plot how far solvers are from the best known values, against the time that they took."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from memcomp_lightning.errors import require

Curve = Sequence[tuple[float, float]]
"""Seconds and gap of one answer: each time that it became better, and at the end."""

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
_MARKS = "os^Dv<>"
_SHORTEST = 1e-4


def plot_gaps(curves: Mapping[str, Sequence[Curve]], *, title: str = "") -> Figure:
    """Gap against time of each solver: a mark for each answer, and a line of the mean on the way.

    The line begins where each of the solver's answers has a value; where no answer has more than its end, there is
    none.

    Args:
        curves: Of each solver, one for each problem and seed; gaps are shares of the best known value, 0 is there.
        title: Printed above.

    Raises:
        SettingError: There is no curve.
    """
    require(any(curves.values()), "curves", dict(curves), "one answer or more")
    figure = Figure(figsize=(5.6, 3.8), layout="constrained")
    axes = figure.add_subplot()
    for number, (name, own) in enumerate(curves.items()):
        if not own:
            continue
        colour, mark = _COLOURS[number % len(_COLOURS)], _MARKS[number % len(_MARKS)]
        time, gap = np.array([curve[-1] for curve in own]).T
        axes.plot(np.maximum(time, _SHORTEST), 100 * gap, mark, markersize=4, color=colour, label=name)
        if any(len(curve) > 1 for curve in own):
            time, mean = _mean(own)
            axes.step(np.maximum(time, _SHORTEST), 100 * mean, where="post", color=colour, linewidth=1.2)
    sizes = [abs(gap) for own in curves.values() for curve in own for _, gap in curve if gap]
    axes.set_xscale("log")
    axes.set_yscale("symlog", linthresh=100 * min(sizes, default=0.01))
    axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
    axes.set_xlabel("seconds")
    axes.set_ylabel("gap to the best known value (%)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize="small")
    if title:
        axes.set_title(title, fontsize="medium", loc="left")
    return figure


def _mean(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray]:
    """Times at which any curve changes, once all have begun, and the mean of their gaps from then on."""
    begin = max(curve[0][0] for curve in curves)
    times = np.unique([begin, *(t for curve in curves for t, _ in curve if t > begin)])
    gaps = []
    for curve in curves:
        time, gap = np.array(curve).T
        gaps.append(gap[np.searchsorted(time, times, side="right") - 1])
    return times, np.mean(gaps, axis=0)
