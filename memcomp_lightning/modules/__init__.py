"""The LightningModules, each for one stage of training: pretraining, up-down training or fine-tuning."""

from memcomp_lightning.modules.baseline import BaselineClassifier
from memcomp_lightning.modules.classifier import Classifier
from memcomp_lightning.modules.energy import EnergyPretraining
from memcomp_lightning.modules.finetuning import DBNClassifier
from memcomp_lightning.modules.stage import NotTrainedError, StageModule
from memcomp_lightning.modules.updown import UpDown
from memcomp_lightning.modules.weights import CheckpointError, load_weights, save_weights

__all__ = [
    "BaselineClassifier",
    "CheckpointError",
    "Classifier",
    "DBNClassifier",
    "EnergyPretraining",
    "NotTrainedError",
    "StageModule",
    "UpDown",
    "load_weights",
    "save_weights",
]
