"""Pictures of a comparison of density models: all methods of a table, and how training went."""

import numpy as np
from matplotlib.figure import Figure

from memcomp_lightning.studies.density.results import Densities, Found

TICKS = (-30, -10, -3, -1, 0)
"""Nats, linear above -1 and logarithmic below."""


def density_figures(results: Densities) -> dict[str, Figure]:
    """By name: test likelihoods of all tables, and held-out likelihood against time for each."""
    return {
        "density": _test(results),
        **{f"density_{table}": _training(results, table) for table in results.tables},
    }


def _test(results: Densities) -> Figure:
    """A panel a table: nats below the best; energy models filled, peers open, bars 95 % intervals over seeds."""
    tables = results.tables
    names = [name for name in (*results.plan.models, *results.peers) if any(name in results.of(t) for t in tables)]
    figure = Figure(figsize=(2.6 + 2.1 * len(tables), 1.2 + 0.24 * len(names)), layout="constrained")
    panels = figure.subplots(1, len(tables), sharey=True, squeeze=False)[0]
    for axes, table in zip(panels, tables, strict=True):
        found = results.of(table)
        known = {name: own for name, own in found.items() if own.known}
        top = max((own.mean for own in known.values()), default=0.0)
        floor = next((own.independent for own in found.values() if np.isfinite(own.independent)), None)
        for name, own in found.items():
            _mark(axes, names.index(name), own, top, is_model=name in results.plan.models)
        axes.axvline(0.0, color="0.7", lw=0.8)
        axes.set_title(f"{table}\nbest {top:.2f}" + ("" if floor is None else f", bits alone {floor:.1f}"), size=8)
        axes.set_xscale("symlog", linthresh=1.0)
        axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
        axes.set_xticks([], minor=True)
        axes.set_xlim(right=0.5)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.25, axis="x")
    panels[0].set_yticks(range(len(names)), [results.label(name) for name in names], size=8)
    panels[0].invert_yaxis()
    figure.supxlabel(
        "test log-likelihood less that of the best, nats a row\n(crosses: estimates of log Z disagree)", size=8
    )
    return figure


def _mark(axes: object, y: int, own: Found, top: float, *, is_model: bool) -> None:
    colour = "C0" if is_model else "C3"
    if not own.known:
        axes.plot([own.mean - top], [y], marker="x", color=colour, ls="")  # type: ignore[attr-defined]
        return
    face = colour if is_model else "white"
    error = None if np.isnan(own.half_width) else [own.half_width]
    axes.errorbar(  # type: ignore[attr-defined]
        [own.mean - top], [y], xerr=error, fmt="o", color=colour, mfc=face, ms=5, lw=1.2
    )


def _training(results: Densities, table: str) -> Figure:
    """Held-out likelihood of each energy model against seconds of training, at its chosen setting."""
    figure = Figure(figsize=(8.0, 4.6), layout="constrained")
    axes = figure.subplots()
    lowest = np.inf
    for number, name in enumerate(results.plan.models):
        for record in results.reported(table, name):
            values, n_seeds = record.measured("valid"), len(record.measures["valid"][0])
            x = np.array(record.seconds) / n_seeds
            line = ("-", "--", ":")[number // 10 % 3]
            axes.plot(x, np.median(values, axis=1), color=f"C{number % 10}", ls=line, label=results.label(name))
            finite = values[np.isfinite(values)]
            lowest = min(lowest, np.quantile(finite, 0.25)) if finite.size else lowest
    if np.isfinite(lowest):
        axes.set_ylim(bottom=lowest)
    axes.set(
        xscale="log", xlabel="seconds of the processor, a seed", ylabel="log-likelihood of held-out rows, nats"
    )
    axes.grid(alpha=0.25)
    axes.legend(fontsize=7, frameon=False)
    axes.set_title(f"{table}: median over seeds, the lower of AIS and reverse AIS", size=9)
    return figure
