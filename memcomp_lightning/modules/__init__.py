"""LightningModules: a stage of training each."""

from memcomp_lightning.modules.baseline import BaselineClassifier
from memcomp_lightning.modules.classifier import Classifier, Score, evaluate, score
from memcomp_lightning.modules.energy import EnergyPretraining
from memcomp_lightning.modules.finetuning import DBNClassifier
from memcomp_lightning.modules.joint import BoltzmannPretraining, DBMPretraining, joined
from memcomp_lightning.modules.losses import LOSSES, Loss, cross_entropy, squared_error
from memcomp_lightning.modules.pretraining import DBNPretraining
from memcomp_lightning.modules.stage import DivergedError, NotTrainedError, OptimizerFactory, StageModule
from memcomp_lightning.modules.weights import CheckpointError, load_weights, save_weights

__all__ = [
    "LOSSES",
    "BaselineClassifier",
    "BoltzmannPretraining",
    "CheckpointError",
    "Classifier",
    "DBMPretraining",
    "DBNClassifier",
    "DBNPretraining",
    "DivergedError",
    "EnergyPretraining",
    "Loss",
    "NotTrainedError",
    "OptimizerFactory",
    "Score",
    "StageModule",
    "cross_entropy",
    "evaluate",
    "joined",
    "load_weights",
    "save_weights",
    "score",
    "squared_error",
]
