"""The paper's Figs. 4 to 6: test accuracy against pretraining iterations or passes, and the controls."""

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from memcomp_lightning.studies.comparison import signed
from memcomp_lightning.studies.results import Claim, Point, Results
from memcomp_lightning.studies.verdicts import gains_by_pretraining, horizontal_arrow, vertical_arrow

# Okabe and Ito's colours, which colour-blind readers tell apart.
_COLOURS = ("#D55E00", "#0072B2", "#009E73", "#E69F00", "#CC79A7", "#56B4E9", "0.25", "0.55")
_MARKERS = ("s", "o", "^", "D", "v", "P", "X", "*")
_LINES = ("--", ":", "-.", (0, (5, 1)), (0, (1, 1)), (0, (3, 1, 1, 1)))


def accuracy_figures(results: Results) -> dict[str, Figure]:
    """All pictures of a figure, by the names of their files."""
    name = results.plan.name
    controls = {f"{name}_controls": plot_controls(results)}
    if results.plan.against == "passes":
        return {name: plot_against_passes(results), **controls}
    if any(len(results.lengths(curve)) > 1 for curve in results.curves):
        return {name: plot_against_iterations(results), **controls}
    return controls


def plot_against_iterations(results: Results, *, width: float = 7.2, height: float = 3.1) -> Figure:
    """A panel for each number of passes (Figs. 4 and 5): curves with sigma / sqrt(n), arrows with their lengths.

    Curves with several pretraining lengths are lines; networks without pretraining are level lines. A panel has
    ``width`` and ``height``, in inches.
    """
    passes = results.plan.passes
    figure = Figure(figsize=(width, height * len(passes) + 0.5), layout="constrained")
    panels = figure.subplots(len(passes), 1, sharex=True, squeeze=False)[:, 0]
    lines = [curve for curve in results.curves if len(results.lengths(curve)) > 1]
    levels = [
        curve for curve in results.curves if results.lengths(curve) == [0] and curve not in results.plan.claimed
    ]
    for letter, axes, done in zip("abcdefgh", panels, passes, strict=False):
        for number, curve in enumerate(lines):
            lengths = results.lengths(curve)
            _errorbar(axes, results, curve, number, lengths, [results.point(curve, n, done) for n in lengths])
        for number, curve in enumerate(levels[: len(_LINES)]):
            mean = results.point(curve, 0, done).mean
            colour = _COLOURS[(len(lines) + number) % len(_COLOURS)]
            axes.axhline(mean, color=colour, lw=1.1, linestyle=_LINES[number], label=results.label(curve))
        for number, claim in enumerate(results.plan.claims):
            if set(claim.curves) <= set(results.curves):
                _arrows(axes, results, claim, done, column=number)
        axes.set(ylabel="test accuracy", title=f"({letter}) {done} back-propagation passes")
        axes.title.set_size(10)
        axes.grid(alpha=0.25)
    panels[-1].set_xlabel("pretraining iterations N of each layer")
    _finish(figure, results, panels[0])
    return figure


def plot_against_passes(results: Results, *, width: float = 6.8, height: float = 4.6) -> Figure:
    """Accuracy against fine-tuning passes (Fig. 6), the end of training in the inset; sizes are in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots()
    passes = results.plan.passes
    inset = axes.inset_axes((0.42, 0.12, 0.55, 0.5))
    for panel, shown in ((axes, passes), (inset, [p for p in passes if p >= passes[-1] / 10])):
        for number, curve in enumerate(results.curves):
            _errorbar(panel, results, curve, number, shown, [results.last(curve, done) for done in shown])
        panel.grid(alpha=0.25)
    middle = float(np.median([results.last(curve, passes[-1]).mean for curve in results.curves]))
    inset.set_ylim(middle - 0.025, middle + 0.02)
    inset.tick_params(labelsize=7)
    axes.set(xscale="log", xlabel="back-propagation passes", ylabel="test accuracy")
    _finish(figure, results, axes)
    return figure


def plot_controls(results: Results, *, width: float = 7.2) -> Figure:
    """Every curve at its last N after each number of passes: mean and standard error, a row each; inches wide."""
    passes = results.plan.passes if len(results.plan.passes) <= 4 else results.plan.passes[-1:]
    curves, claimed = results.curves, results.plan.claimed
    figure = Figure(figsize=(width, 0.26 * len(curves) + 1.2), layout="constrained")
    panels = figure.subplots(1, len(passes), sharey=True, squeeze=False)[0]
    rows = np.arange(len(curves))[::-1]
    for axes, done in zip(panels, passes, strict=True):
        for row, curve in zip(rows, curves, strict=True):
            point = results.last(curve, done)
            colour = _COLOURS[claimed.index(curve) % len(_COLOURS)] if curve in claimed else "0.35"
            error = None if math.isnan(point.error) else 2 * point.error
            axes.errorbar(point.mean, row, xerr=error, fmt="o", ms=4, color=colour, capsize=2)
            if curve in claimed[:2]:
                axes.axvline(point.mean, color=colour, lw=0.7, alpha=0.6)
        axes.set_title(f"{done} passes", size=9)
        axes.grid(alpha=0.25, axis="x")
        axes.tick_params(labelsize=8)
    labels = []
    for curve in curves:
        last = results.lengths(curve)[-1]
        labels.append(results.label(curve) + (f", N = {last}" if last else ""))
    panels[0].set_yticks(rows, labels)
    figure.supxlabel("test accuracy (mean ± 2 standard errors)", size=9)
    figure.suptitle(_title(results), size=10)
    return figure


def _errorbar(
    axes: Axes,
    results: Results,
    curve: str,
    number: int,
    x: Sequence[int],
    points: Sequence[Point],
) -> None:
    axes.errorbar(
        x,
        [point.mean for point in points],
        [0.0 if math.isnan(point.error) else point.error for point in points],
        color=_COLOURS[number % len(_COLOURS)],
        marker=_MARKERS[number % len(_MARKERS)],
        ms=3.5,
        lw=1.2,
        elinewidth=0.8,
        capsize=1.5,
        label=results.label(curve),
    )


def _arrows(axes: Axes, results: Results, claim: Claim, passes: int, *, column: int) -> None:
    """The paper's two arrows: iterations saved, and accuracy gained at the last N."""
    last = results.lengths(claim.better)[-1]
    low, high = (results.last(curve, passes).mean for curve in claim.curves)
    x = last + 1.2 + 6 * column
    style = {"arrowstyle": "<->", "color": "black", "lw": 1.1, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=(x, high), xytext=(x, low), arrowprops=style, annotation_clip=False)
    gap = signed(vertical_arrow(results, claim, passes).effect)
    axes.annotate(gap, xy=(x + 0.6, (low + high) / 2), va="center", size=8, annotation_clip=False)
    saved = horizontal_arrow(results, claim, passes)
    if saved is not None and saved[0] < saved[1] and gains_by_pretraining(results, claim, passes):
        axes.annotate("", xy=(saved[0], low), xytext=(saved[1], low), arrowprops={**style, "arrowstyle": "->"})
        axes.annotate(
            f"{saved[1] - saved[0]} iterations",
            xy=(sum(saved) / 2, low),
            xytext=(0, -11),
            textcoords="offset points",
            ha="center",
            size=8,
        )
    axes.set_xlim(right=x + 4.8)


def _title(results: Results) -> str:
    return f"{results.plan.data}: {results.plan.title}\n{results.plan.scale}"


def _finish(figure: Figure, results: Results, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=7.5, frameon=False)
    figure.suptitle(_title(results), size=10)
