"""LightningModules: a stage of training each."""

from memcomp_lightning.modules.baseline import BaselineClassifier
from memcomp_lightning.modules.classifier import Classifier, Score, evaluate, score
from memcomp_lightning.modules.finetuning import DBNClassifier
from memcomp_lightning.modules.losses import LOSSES, Loss, cross_entropy, squared_error
from memcomp_lightning.modules.pretraining import DBNPretraining
from memcomp_lightning.modules.stage import DivergedError, OptimizerFactory, StageModule
from memcomp_lightning.modules.weights import CheckpointError, load_weights, save_weights

__all__ = [
    "LOSSES",
    "BaselineClassifier",
    "CheckpointError",
    "Classifier",
    "DBNClassifier",
    "DBNPretraining",
    "DivergedError",
    "Loss",
    "OptimizerFactory",
    "Score",
    "StageModule",
    "cross_entropy",
    "evaluate",
    "load_weights",
    "save_weights",
    "score",
    "squared_error",
]
