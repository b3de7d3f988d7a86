"""Samplers of the negative phase: one file each, one protocol."""

from memcomp_lightning.samplers.base import NegativePhaseSampler
from memcomp_lightning.samplers.cd import CD
from memcomp_lightning.samplers.exact import Exact
from memcomp_lightning.samplers.gibbs import positive_phase
from memcomp_lightning.samplers.ground_state import GroundState
from memcomp_lightning.samplers.pcd import PCD
from memcomp_lightning.samplers.quench import Quench

__all__ = ["CD", "PCD", "Exact", "GroundState", "NegativePhaseSampler", "Quench", "positive_phase"]
