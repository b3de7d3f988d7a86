"""A trained model, used: it is loaded, sampled, asked for what is missing, scored, exported."""

from memcomp_lightning.trained.alone import LoadWarning
from memcomp_lightning.trained.features import transform
from memcomp_lightning.trained.generative import load_generative
from memcomp_lightning.trained.imputation import Imputation, impute
from memcomp_lightning.trained.run import Run, load
from memcomp_lightning.trained.sampling import Samples, sample
from memcomp_lightning.trained.scoring import Scores, score

__all__ = [
    "Imputation",
    "LoadWarning",
    "Run",
    "Samples",
    "Scores",
    "impute",
    "load",
    "load_generative",
    "sample",
    "score",
    "transform",
]
