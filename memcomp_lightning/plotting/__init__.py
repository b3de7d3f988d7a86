"""Arrays in, pictures out."""

from memcomp_lightning.plotting.grid import picture_grid

__all__ = ["picture_grid"]
