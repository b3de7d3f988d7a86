"""What a sampler is worth: likelihood against updates and against time, and the bias of the gradient."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from memcomp_lightning.studies.measures import MEASURES
from memcomp_lightning.studies.worth import Worth


def plot_worth(worth: Worth, data_set: str, *, width: float = 13.0, height: float = 4.6) -> Figure:
    """Panels of one data set: score against updates and seconds, and, if known, cosine with the exact gradient.

    Lines are medians over replicas, each method at its best learning rate; the dotted line of a judged method is
    its worst replica. Sizes are in inches.
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    records = {method: worth.best(data_set, method) for method in worth.methods(data_set)}
    has_bias = any(np.isfinite(worth.values(record, "cosine")).any() for record in records.values())
    panels = figure.subplots(1, 3 if has_bias else 2)
    by_update, by_time = panels[:2]
    settings = worth.plan.data_sets[data_set]
    measure = MEASURES[settings.measure]
    for number, (method, record) in enumerate(records.items()):
        scores = worth.values(record)
        claimed = method in worth.plan.claimed
        line = "-" if claimed else ("--", "-.")[number // 10 % 2]
        style = {"color": f"C{number % 10}", "ls": line, "lw": 1.6 if claimed else 1.0}
        label = f"{worth.plan.methods[method].label} (lr = {record.value:g})"
        median, worst = np.median(scores, axis=1), scores.max(axis=1)
        for axes, x in ((by_update, record.at), (by_time, record.seconds)):
            axes.plot(x, median, label=label, **style)
            if claimed:
                axes.plot(x, worst, color=style["color"], ls=":", lw=0.8)
        cosines = worth.values(record, "cosine")
        if np.isfinite(cosines).any():
            panels[2].plot(record.at, np.nanmedian(cosines, axis=1), **style)
    by_update.set(xlabel="updates", ylabel=measure.title, xscale="log")
    by_time.set(xlabel="seconds of all replicas on one thread", xscale="log")
    for axes in panels[2:]:
        axes.set(xlabel="updates", ylabel="cosine of the mean gradient with the exact one", xscale="log")
    for axes in (by_update, by_time):
        if _finite_range(axes) and measure.is_divergence:
            axes.set_yscale("log")
    for axes in panels:
        axes.grid(alpha=0.25)
        axes.tick_params(labelsize=8)
    handles, labels = by_update.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=7, frameon=False)
    figure.suptitle(settings.label, size=10)
    return figure


def _finite_range(axes: Axes) -> bool:
    """Leave out what diverged: from the lowest value to a little above the first; say whether any is finite."""
    lines = [np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()]
    values = np.concatenate(lines)
    values = values[np.isfinite(values) & (values > 0)]
    if values.size:
        first = float(np.median([line[0] for line in lines]))
        top = 1.3 * first if math.isfinite(first) else float(values.max())
        axes.set_ylim(float(values.min()) / 1.1, max(top, float(values.min()) * 1.1))
    return bool(values.size)
