"""Samplers of the positive phase: hidden units given the data, where they are coupled to each other."""

from memcomp_lightning.samplers.positive.base import PositivePhase, PositivePhaseSampler
from memcomp_lightning.samplers.positive.clamped_gibbs import ClampedGibbs
from memcomp_lightning.samplers.positive.exact import ExactPosterior
from memcomp_lightning.samplers.positive.mean_field import MeanField
from memcomp_lightning.samplers.positive.missing import posterior_of

__all__ = [
    "ClampedGibbs",
    "ExactPosterior",
    "MeanField",
    "PositivePhase",
    "PositivePhaseSampler",
    "posterior_of",
]
