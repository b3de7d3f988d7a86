"""Bridges to other projects; each needs its own package, and says which where it is missing."""

from typing import Any

from memcomp_lightning.interop.annealer_graph import annealer_graph

_OF_DIMOD = ("AnnealerSamples", "DimodSolver", "from_bqm", "maximum_pseudo_likelihood_beta", "to_bqm")

__all__ = [*_OF_DIMOD, "DmmDimodSampler", "QpuSampler", "annealer_graph"]


def __getattr__(name: str) -> Any:
    """Import what needs dimod when it is asked for."""
    if name in (*_OF_DIMOD, "DmmDimodSampler"):
        from memcomp_lightning.interop import dimod  # first: it says what to install

        if name in _OF_DIMOD:
            return getattr(dimod, name)
        from memcomp_lightning.interop.dmm_sampler import DmmDimodSampler

        return DmmDimodSampler
    if name == "QpuSampler":
        from memcomp_lightning.interop.qpu import QpuSampler

        return QpuSampler
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
