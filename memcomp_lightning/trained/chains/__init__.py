"""Chains of a trained model: where they start, what is watched along them, and how rows are taken from them."""

from memcomp_lightning.trained.chains.drawing import METHODS, Effort, draw
from memcomp_lightning.trained.chains.report import Exchanges, Mixing
from memcomp_lightning.trained.chains.target import Target

__all__ = ["METHODS", "Effort", "Exchanges", "Mixing", "Target", "draw"]
