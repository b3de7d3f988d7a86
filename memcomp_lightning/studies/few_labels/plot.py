"""Accuracy against labels, a panel for each kind of method."""

import numpy as np
from matplotlib.figure import Figure

from memcomp_lightning.studies.few_labels.results import Accuracies


def few_labels_figures(results: Accuracies) -> dict[str, Figure]:
    """One figure: mean accuracy over draws with 95 % intervals, a panel each with the best pretraining in grey."""
    panels = list(dict.fromkeys(method.panel for method in results.plan.methods.values()))
    shown = [panel for panel in panels if _methods(results, panel)]
    figure = Figure(figsize=(4.3 * len(shown), 4.6), layout="constrained")
    all_axes = figure.subplots(1, len(shown), sharex=True, sharey=True, squeeze=False)[0]
    for panel, axes in zip(shown, all_axes, strict=True):
        grey = [(n, best) for n in results.labels if (best := results.best(n)) is not None]
        x = [results.n_labels(n) for n, _ in grey]
        axes.plot(x, [results.of(n, best).mean for n, best in grey], color="0.8", lw=5, zorder=0)
        for number, name in enumerate(_methods(results, panel)):
            labels = [n for n in results.labels if name in results.methods(n)]
            found = [results.of(n, name) for n in labels]
            axes.errorbar(
                # Beside each other where their intervals would lie on top of each other.
                [results.n_labels(n) * 1.02**number for n in labels],
                [own.mean for own in found],
                yerr=np.nan_to_num([own.half_width for own in found]),
                label=results.plan.methods[name].label,
                marker="os^vDP*X"[number // 10 % 8],
                color=f"C{number % 10}",
                ms=4,
                lw=1.2,
                capsize=2,
            )
        axes.set(xscale="log", title=panel, xlabel="labels")
        numbers = sorted({results.n_labels(n) for n in results.labels})
        axes.set_xticks(numbers, [f"{n:,}" for n in numbers])
        axes.minorticks_off()
        axes.grid(alpha=0.25)
        axes.legend(fontsize=7, frameon=False, loc="lower right")
    # Intervals of two draws may be wider than the picture: they are cut off.
    means = [results.of(n, name).mean for n in results.labels for name in results.methods(n)]
    margin = 0.05 * (max(means) - min(means)) + 0.01
    all_axes[0].set_ylim(min(means) - margin, max(means) + margin)
    all_axes[0].set_ylabel("accuracy on test images (grey: best pretraining)")
    return {"few_labels": figure}


def _methods(results: Accuracies, panel: str) -> list[str]:
    measured = {name for n in results.labels for name in results.methods(n)}
    return [name for name, method in results.plan.methods.items() if method.panel == panel and name in measured]
