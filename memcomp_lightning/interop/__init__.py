"""Our solvers in dimod, and D-Wave's annealers: each needs its own package, and says which where it is missing."""

from memcomp_lightning.interop.annealer_graph import annealer_graph
from memcomp_lightning.optional import on_demand

__all__ = ["DmmDimodSampler", "QpuSampler", "annealer_graph"]

__getattr__ = on_demand(__name__, {"DmmDimodSampler": "dmm_sampler", "QpuSampler": "qpu"})
