"""Draw arrays: grids of pictures, histograms, samples against data, gaps of solvers, and trajectories of a DMM."""

from memcomp_lightning.plotting.correlations import plot_correlations
from memcomp_lightning.plotting.densities import plot_densities
from memcomp_lightning.plotting.gaps import plot_gaps
from memcomp_lightning.plotting.grid import picture_grid
from memcomp_lightning.plotting.histograms import plot_histograms
from memcomp_lightning.plotting.imputation import DiscreteCells, RealCells, plot_imputation
from memcomp_lightning.plotting.likelihoods import plot_likelihoods
from memcomp_lightning.plotting.logo import plot_logo
from memcomp_lightning.plotting.marginals import plot_marginals
from memcomp_lightning.plotting.plane import plot_plane
from memcomp_lightning.plotting.points import Points
from memcomp_lightning.plotting.rendering import rendered
from memcomp_lightning.plotting.state_frequencies import plot_state_frequencies
from memcomp_lightning.plotting.state_weights import plot_state_weights
from memcomp_lightning.plotting.trajectory import plot_trajectory

__all__ = [
    "DiscreteCells",
    "Points",
    "RealCells",
    "picture_grid",
    "plot_correlations",
    "plot_densities",
    "plot_gaps",
    "plot_histograms",
    "plot_imputation",
    "plot_likelihoods",
    "plot_logo",
    "plot_marginals",
    "plot_plane",
    "plot_state_frequencies",
    "plot_state_weights",
    "plot_trajectory",
    "rendered",
]
