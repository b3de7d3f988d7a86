"""Kinds of units, one file each: what a layer's values are, and how they follow from their fields."""

from memcomp_lightning.models.units.base import Bits, Units, all_states
from memcomp_lightning.models.units.bernoulli import Bernoulli
from memcomp_lightning.models.units.categorical import Categorical
from memcomp_lightning.models.units.gaussian import Gaussian
from memcomp_lightning.models.units.mixed import Mixed, side_by_side
from memcomp_lightning.models.units.relu import ReLU
from memcomp_lightning.models.units.spin import Spin

__all__ = [
    "Bernoulli",
    "Bits",
    "Categorical",
    "Gaussian",
    "Mixed",
    "ReLU",
    "Spin",
    "Units",
    "all_states",
    "side_by_side",
]
