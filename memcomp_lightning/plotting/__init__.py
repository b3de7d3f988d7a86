"""Arrays in, pictures out."""

from memcomp_lightning.plotting.accuracy import plot_against_iterations, plot_against_passes, plot_controls
from memcomp_lightning.plotting.grid import picture_grid
from memcomp_lightning.plotting.histograms import plot_histograms
from memcomp_lightning.plotting.rendering import rendered
from memcomp_lightning.plotting.trajectory import plot_trajectory
from memcomp_lightning.plotting.worth import plot_worth

__all__ = [
    "picture_grid",
    "plot_against_iterations",
    "plot_against_passes",
    "plot_controls",
    "plot_histograms",
    "plot_trajectory",
    "plot_worth",
    "rendered",
]
