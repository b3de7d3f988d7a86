"""Bridges to other projects; each needs its own package, and says which where it is missing."""

from memcomp_lightning.interop.annealer_graph import annealer_graph

__all__ = ["annealer_graph"]
