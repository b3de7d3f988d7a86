"""Draw arrays: grids of pictures, histograms, gaps of solvers, and trajectories of a DMM."""

from memcomp_lightning.plotting.gaps import plot_gaps
from memcomp_lightning.plotting.grid import picture_grid
from memcomp_lightning.plotting.histograms import plot_histograms
from memcomp_lightning.plotting.rendering import rendered
from memcomp_lightning.plotting.trajectory import plot_trajectory

__all__ = [
    "picture_grid",
    "plot_gaps",
    "plot_histograms",
    "plot_trajectory",
    "rendered",
]
