"""Samplers of the negative phase: they supply states that stand for the model's own distribution."""

from memcomp_lightning.optional import on_demand
from memcomp_lightning.samplers.base import NegativePhaseSampler, positive_phase, tensors_of, with_tensors
from memcomp_lightning.samplers.bfloat16 import InBfloat16
from memcomp_lightning.samplers.block_annealing import BlockAnnealing
from memcomp_lightning.samplers.cd import CD
from memcomp_lightning.samplers.exact import Exact
from memcomp_lightning.samplers.ground_state import GroundState
from memcomp_lightning.samplers.mode_assisted import ModeAssisted, ModeSchedule
from memcomp_lightning.samplers.parallel_tempering import ParallelTempering
from memcomp_lightning.samplers.pcd import PCD
from memcomp_lightning.samplers.positive import (
    ClampedGibbs,
    ExactPosterior,
    MeanField,
    PositivePhase,
    PositivePhaseSampler,
)
from memcomp_lightning.samplers.pseudo_likelihood import PseudoLikelihood
from memcomp_lightning.samplers.quench import Quench

__all__ = [
    "CD",
    "PCD",
    "BlockAnnealing",
    "ClampedGibbs",
    "Exact",
    "ExactPosterior",
    "GroundState",
    "InBfloat16",
    "MeanField",
    "ModeAssisted",
    "ModeSchedule",
    "NegativePhaseSampler",
    "ParallelTempering",
    "PositivePhase",
    "PositivePhaseSampler",
    "PseudoLikelihood",
    "Quench",
    "positive_phase",
    "tensors_of",
    "with_tensors",
]

__getattr__ = on_demand(__name__, {"AnnealerSamples": "annealer", "maximum_pseudo_likelihood_beta": "annealer"})
