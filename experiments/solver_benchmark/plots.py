"""The benchmark's pictures. Colours: Okabe and Ito, distinct for all common kinds of colour vision."""

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import measure
import numpy as np
from report import Outcome, Record
from sweep import Row
from verdicts import DMM, SA, planted_fit

mpl.use("Agg")
import matplotlib.pyplot as plt

STYLE = {
    "best": ("#000000", "*"),
    "annealing": ("#009E73", "D"),
    "tabu": ("#0072B2", "^"),
    "crossover": ("#CC79A7", "X"),
    "DMM": ("#E69F00", "o"),
    "DMM, steps tuned": ("#F0E442", "o"),
    "DMM bond, steps tuned": ("#8C6D31", "o"),
    "SA (dwave)": ("#D55E00", "s"),
    "tabu (dwave)": ("#56B4E9", "v"),
    "descent": ("#999999", "1"),
    "simulated bifurcation": ("#666666", "P"),
}


def time_to_solution(path: Path, table: Sequence[Record]) -> None:
    """A row a family, a dot a solver with its interval; open triangles are bounds from below."""
    table = [record for record in table if "gap" not in record]
    names = list(dict.fromkeys(record["family"] for record in table))
    if not names:
        return
    figure, axes = plt.subplots(figsize=(9, 1.2 + 0.5 * len(names)), layout="constrained")
    for solver, (colour, marker) in STYLE.items():
        rows = [record for record in table if record["solver"] == solver]
        shift = 0.075 * (list(STYLE).index(solver) - len(STYLE) / 2 + 0.5)
        for censored in (False, True):
            chosen = [
                (names.index(r["family"]) + shift, r["TTS99"]) for r in rows if bool(r["TTS99"].mark) == censored
            ]
            if not chosen:
                continue
            y, intervals = zip(*chosen, strict=True)
            value, low, high = 1e3 * np.array([interval[:3] for interval in intervals]).T
            errors = None if censored else np.clip((value - low, high - value), 0, None)
            axes.errorbar(
                value, y, xerr=errors, fmt=">" if censored else marker, ms=5, lw=1.2, color=colour,
                mfc="white" if censored else colour,
            )  # fmt: skip
    axes.set(xscale="log", xlabel="time to solution with 99 %, ms on one core (geometric mean, 95 %)")
    axes.set(yticks=range(len(names)), yticklabels=names, ylim=(len(names) - 0.5, -0.5))
    for k in range(1, len(names)):
        axes.axhline(k - 0.5, color="0.9", lw=0.8)
    axes.grid(axis="x", color="0.9")
    axes.set_axisbelow(True)
    _legend(figure)
    _save(path, figure)


def gap_against_time(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Expected relative gap of the best read so far, the best of each solver's settings at each time."""
    outcomes = [outcome for outcome in outcomes if outcome.family.horizon is not None]
    if not outcomes:
        return
    n_columns = min(3, len(outcomes))
    n_rows = -(-len(outcomes) // n_columns)
    size = {"figsize": (max(3.6 * n_columns, 8.0), 3.0 * n_rows + 0.6), "layout": "constrained"}
    figure, grid = plt.subplots(n_rows, n_columns, squeeze=False, sharey=True, **size)
    times = np.geomspace(1e-3, 10, 60)
    for axes, outcome in zip(grid.flat, outcomes, strict=False):
        for solver, labels in outcome.settings.items():
            curves = np.array([[_mean_gap(outcome, solver, label, t) for t in times] for label in labels])
            found = ~np.isnan(curves).all(0)
            curve = np.minimum.accumulate(np.nanmin(curves[:, found], axis=0))
            axes.plot(times[found], np.maximum(curve, 1e-7), color=STYLE[solver][0])
        axes.set(xscale="log", yscale="log", ylim=(7e-8, 1), xlabel="wall time, s")
        axes.set_title(outcome.family.name, fontsize=8)
        axes.grid(color="0.9")
    for axes in grid.flat[len(outcomes) :]:
        axes.axis("off")
    for axes in grid[:, 0]:
        axes.set_ylabel("relative gap (1e-7: none)")
    _legend(figure)
    _save(path, figure)


def _mean_gap(outcome: Outcome, solver: str, label: str, horizon: float) -> float:
    slowest = max(row["seconds"] for row in outcome.runs[solver, label])
    if horizon > 2 * slowest:  # more reads than were measured
        return float("nan")
    return float(np.mean(outcome.gaps(solver, label, horizon)))


def _legend(figure: plt.Figure) -> None:
    """All solvers above the picture."""
    handles = [
        plt.Line2D([], [], color=colour, marker=marker, label=name) for name, (colour, marker) in STYLE.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4, frameon=False)


def planted_scaling(path: Path, outcomes: Sequence[Outcome]) -> None:
    """TTS99 of every planted instance against size, with a power law and an exponential through each solver's."""
    planted = sorted((o for o in outcomes if o.family.group == "planted loops"), key=lambda o: o.family.n)
    if not planted:
        return
    figure, axes = plt.subplots(figsize=(6, 4.2), layout="constrained")
    for solver in ("best", DMM, SA):
        colour, marker = STYLE[solver]
        for outcome in planted:
            if solver not in outcome.settings:
                continue
            values, censored = measure.estimate(outcome.tallies(solver, outcome.hindsight(solver)))
            for value, is_bound in zip(values, censored, strict=True):
                face = "white" if is_bound else colour
                axes.plot(outcome.family.n, value * 1e3, "^" if is_bound else marker, color=colour, mfc=face)
        for power, line in ((True, "-"), (False, ":")):
            fit = planted_fit(planted, solver, power=power)
            if fit is not None:
                n = np.linspace(planted[0].family.n, planted[-1].family.n, 100)
                slope, low, high, _ = fit.slope
                law = "n^{:.2f} [{:.2f}, {:.2f}]" if power else "exp({:.4f} n) [{:.4f}, {:.4f}]"
                curve = np.exp(fit.intercept + slope * (np.log(n) if power else n))
                axes.plot(n, curve * 1e3, line, color=colour, label=f"{solver}: {law.format(slope, low, high)}")
    axes.set(xscale="log", yscale="log", xlabel="spins", ylabel="time to solution with 99 %, ms")
    axes.set_title("Planted loops, best setting at each size (triangles: bounds from below)", fontsize=9)
    axes.set_xticks([o.family.n for o in planted], [str(o.family.n) for o in planted])
    axes.set_xticks([], minor=True)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, fontsize=8)
    axes.grid(color="0.9", which="both")
    _save(path, figure)


def linear_cost(path: Path, costs: Sequence[Row]) -> None:
    """Seconds and bytes of a sparse problem against its couplings, with lines of slope one."""
    if not costs:
        return
    figure, panels = plt.subplots(1, 2, figsize=(8, 3.4), layout="constrained")
    x = np.array([row["n_couplings"] for row in costs])
    columns: list[tuple[str, Callable[[Row], float]]] = [
        ("ms a step and restart", lambda row: row["step_seconds"] * 1e3),
        ("MiB above the problem itself", lambda row: row["bytes"] / 2**20),
    ]
    for axes, (label, value) in zip(panels, columns, strict=True):
        y = np.array([value(row) for row in costs])
        axes.plot(x, y, "o-", color=STYLE[DMM][0])
        axes.plot(x, y[-1] * x / x[-1], ":", color="0.5", label="linear")
        axes.set(xscale="log", yscale="log", xlabel="couplings", ylabel=label)
        axes.legend(frameon=False)
        axes.grid(color="0.9")
    _save(path, figure)


def _save(path: Path, figure: plt.Figure) -> None:
    figure.savefig(path, dpi=130)
    plt.close(figure)
