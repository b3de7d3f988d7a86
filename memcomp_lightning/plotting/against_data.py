"""Samples of a model against its data: the pictures that every kind of data has."""

from matplotlib.figure import Figure

from memcomp_lightning.data.shown import Shown
from memcomp_lightning.plotting.correlations import plot_correlations
from memcomp_lightning.plotting.marginals import plot_marginals
from memcomp_lightning.plotting.plane import plot_plane
from memcomp_lightning.plotting.points import Points


def plot_against_data(
    data: Shown, samples: Shown, heldout: Shown | None = None, *, n_panels: int = 12
) -> dict[str, Figure]:
    """The figures ``marginals``, ``correlations`` and ``plane``; the last two of models with two sites or more.

    Args:
        data: Rows that were trained on; values of the units, not means.
        samples: Rows of samples.
        heldout: Rows that were not trained on: how close to the data one can come.
        n_panels: Most columns whose marginals are drawn, >= 1.
    """
    found = {"marginals": plot_marginals(data.columns, samples.columns, weight=data.weights, n_panels=n_panels)}
    if data.units.n_sites > 1:
        sets = [None if rows is None else Points(rows.entries, rows.weights) for rows in (data, samples, heldout)]
        of_data, of_samples, of_heldout = sets
        assert of_data is not None
        assert of_samples is not None
        site = data.units.site_of().numpy()
        found["correlations"] = plot_correlations(
            of_data, of_samples, of_heldout, site=site, names=data.entry_names
        )
        found["plane"] = plot_plane(of_data, of_samples, of_heldout)
    return found
