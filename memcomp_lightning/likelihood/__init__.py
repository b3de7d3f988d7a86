"""How likely data are under an RBM: log Z by enumeration or annealing, and what follows from it."""

from memcomp_lightning.likelihood.ais import Ais, AisEstimate, ReverseAis, base_of
from memcomp_lightning.likelihood.exact import (
    exact_samples,
    kl_divergence,
    log_likelihood,
    log_partition_function,
    log_pseudo_likelihood,
)

__all__ = [
    "Ais",
    "AisEstimate",
    "ReverseAis",
    "base_of",
    "exact_samples",
    "kl_divergence",
    "log_likelihood",
    "log_partition_function",
    "log_pseudo_likelihood",
]
