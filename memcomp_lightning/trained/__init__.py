"""A trained model, used: it is loaded, sampled, asked for what is missing, scored, exported."""

from memcomp_lightning.trained.run import Run, load
from memcomp_lightning.trained.sampling import Samples, sample

__all__ = ["Run", "Samples", "load", "sample"]
