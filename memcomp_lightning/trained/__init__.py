"""A trained model, used: it is loaded, sampled, asked for what is missing, scored, exported."""

from memcomp_lightning.trained.run import Run, load

__all__ = ["Run", "load"]
