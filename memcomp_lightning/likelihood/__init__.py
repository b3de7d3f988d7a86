"""How likely data are under an energy model: log Z by enumeration or annealing, and what follows from it."""

from memcomp_lightning.likelihood.ais import Ais, AisEstimate, ReverseAis, annealing_products, base_of
from memcomp_lightning.likelihood.boltzmann import base_on_first_class, log_likelihood_bound
from memcomp_lightning.likelihood.both_ways import BothWays, estimate_both_ways
from memcomp_lightning.likelihood.exact import (
    exact_samples,
    kl_divergence,
    log_likelihood,
    log_likelihood_or_bound,
    log_partition_function,
)
from memcomp_lightning.likelihood.generative import RecognitionBound, recognition_bound
from memcomp_lightning.likelihood.pseudo import log_pseudo_likelihood

__all__ = [
    "Ais",
    "AisEstimate",
    "BothWays",
    "RecognitionBound",
    "ReverseAis",
    "annealing_products",
    "base_of",
    "base_on_first_class",
    "estimate_both_ways",
    "exact_samples",
    "kl_divergence",
    "log_likelihood",
    "log_likelihood_bound",
    "log_likelihood_or_bound",
    "log_partition_function",
    "log_pseudo_likelihood",
    "recognition_bound",
]
