"""What an update of a model is, whatever loop it stands in."""

from memcomp_lightning.training.step import EnergyStep, Processes, StepState

__all__ = ["EnergyStep", "Processes", "StepState"]
