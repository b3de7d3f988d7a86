"""Use our solvers in dimod, and D-Wave's annealers here; where a package for it is missing, an error names it."""

from memcomp_lightning.interop.annealer_graph import annealer_graph
from memcomp_lightning.optional import on_demand

__all__ = ["MemcompSampler", "QpuSampler", "annealer_graph"]

__getattr__ = on_demand(__name__, {"MemcompSampler": "memcomp_sampler", "QpuSampler": "qpu"})
