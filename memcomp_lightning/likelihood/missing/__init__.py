"""Missing values given the observed ones of their row: their distribution, and how likely these are."""

from memcomp_lightning.likelihood.missing.annealing import ObservedAis, ObservedEstimate
from memcomp_lightning.likelihood.missing.base import Conditional, ConditionalFinder
from memcomp_lightning.likelihood.missing.chains import MissingChains
from memcomp_lightning.likelihood.missing.choice import Group, finders, of_observed
from memcomp_lightning.likelihood.missing.hidden import HiddenSums
from memcomp_lightning.likelihood.missing.states import MissingSums

__all__ = [
    "Conditional",
    "ConditionalFinder",
    "Group",
    "HiddenSums",
    "MissingChains",
    "MissingSums",
    "ObservedAis",
    "ObservedEstimate",
    "finders",
    "of_observed",
]
