"""Plot how the weight of unsatisfied clauses changes while a DMM runs."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.solvers.dmm.trajectory import Trajectory

Floats = NDArray[np.float64]

# Okabe and Ito's colours, which colour-blind readers tell apart; they differ in lightness, too.
_PATH, _BEST, _BOX = "#0072B2", "#D55E00", "0.35"

_CURVES, _CURVES_ALONE = 0.54, 0.88
"""Share of the panel's height that the curves take, with an inset above them and with the legend alone."""


def plot_trajectory(trajectory: Trajectory, *, last: int = 3, title: str = "") -> Figure:
    """Total weight of unsatisfied clauses against machine time (Manukian et al. 2019, Fig. 2).

    The restarts follow one another on the time axis, so that each one begins with a spike. The large panel shows
    the last few of them, the inset all, with a box around what the large panel shows. The line of the best ends at
    the solver's answer: it counts what descents from copies of the machine's state find, too, a restart's best
    from where it was found.

    Args:
        trajectory: Of one problem, ``(n_restarts, n_records)``; records of no dwell (not run) are left out.
        last: Number of restarts in the large panel, >= 1.
        title: Printed above.

    Raises:
        SettingError: The trajectory is of several problems, or holds no records.
    """
    require_count("last", last)
    shape = tuple(trajectory.time.shape)
    remedy = "Take one: Trajectory(*(field[index] for field in trajectory))."
    require(len(shape) == 2, "trajectory's shape", shape, "(n_restarts, n_records), one problem", remedy)
    time, weight, found, starts = _one_after_another(trajectory)
    require(time.size > 0, "trajectory", f"of shape {shape}", "at least one record of dwell > 0")
    best = np.minimum.accumulate(np.minimum(weight, found))
    n_restarts = len(starts) - 1
    shown = max(n_restarts - last, 0)
    begin, end = float(starts[shown]), float(starts[-1])

    figure = Figure(figsize=(5.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    part = time > begin
    _draw(axes, time[part], weight[part], best[part], linewidth=1.1)
    low, high = _margins(float(best[-1]), float(weight[part].max()))
    axes.set_xlim(*_margins(begin, end, share=0.015))
    axes.set_ylim(low, low + (high - low) / (_CURVES if shown else _CURVES_ALONE))
    # The axis ends where the curves do: the room above is for the inset and the legend.
    axes.spines["left"].set_bounds(low, high)
    axes.set_yticks([tick for tick in axes.get_yticks() if low <= tick <= high])
    axes.vlines(starts[shown + 1 : -1], low, high, color="0.85", linewidth=0.8, zorder=0)
    axes.set_xlabel("machine time (dimensionless)")
    axes.set_ylabel("weight of unsatisfied clauses", y=(_CURVES if shown else _CURVES_ALONE) / 2)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="upper left", frameon=False, fontsize="small", borderaxespad=0, ncols=1 if shown else 2)
    if title:
        axes.set_title(title, fontsize="medium", loc="left")
    if shown:
        inset = axes.inset_axes((0.4, _CURVES + 0.06, 0.6, 0.92 - _CURVES))
        _draw(inset, time, weight, best, linewidth=0.5)
        inset.set_xlim(*_margins(0.0, end, share=0.02))
        inset.set_ylim(*_margins(float(best[-1]), float(weight.max()), share=0.12))
        inset.tick_params(labelsize="x-small", length=2)
        inset.set_title(f"all {n_restarts} restarts", fontsize="x-small", pad=2)
        box = Rectangle((begin, low), end - begin, high - low)
        box.set(facecolor="none", edgecolor=_BOX, linewidth=0.9, zorder=5)
        inset.add_patch(box)
    return figure


def _one_after_another(trajectory: Trajectory) -> tuple[Floats, Floats, Floats, Floats]:
    """Times, weights and found weights ``(n_records,)`` of all restarts; where each begins, and the last ends."""
    fields = (trajectory.time, trajectory.unsatisfied_weight, trajectory.found_weight, trajectory.dwell)
    time, weight, found, dwell = map(to_numpy, fields)
    made = dwell > 0
    was_run = made.any(1)
    time, weight, found, made = time[was_run], weight[was_run], found[was_run], made[was_run]
    starts = np.concatenate(([0.0], np.cumsum((time * made).max(1, initial=0.0))))
    return (time + starts[:-1, None])[made], weight[made], found[made], starts


def _draw(axes: Axes, time: Floats, weight: Floats, best: Floats, *, linewidth: float) -> None:
    (line,) = axes.plot(
        time, best, color=_BEST, linewidth=1.3 * linewidth, linestyle="--", label="best so far,\nwith descents"
    )
    line.set_drawstyle("steps-post")
    axes.plot(time, weight, color=_PATH, linewidth=linewidth, label="machine")


def _margins(low: float, high: float, share: float = 0.06) -> tuple[float, float]:
    """Room on both sides, as a share of the interval."""
    room = share * (high - low) or 0.5
    return low - room, high + room
