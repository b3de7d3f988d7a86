"""Classifiers from few labels: pretrained networks, their controls, and what else rows without labels give."""

from memcomp_lightning.studies.few_labels.autoencoder import DenoisingAutoencoder
from memcomp_lightning.studies.few_labels.classical import (
    HiddenMeans,
    Pixels,
    PrincipalComponents,
    Regression,
    SupportVectors,
)
from memcomp_lightning.studies.few_labels.label_rbm import LabelRbm
from memcomp_lightning.studies.few_labels.networks import BatchNormRelu, Network, Pretrained
from memcomp_lightning.studies.few_labels.pseudo import PseudoLabels
from memcomp_lightning.studies.few_labels.results import Accuracies, read_few_labels
from memcomp_lightning.studies.few_labels.settings import FewLabels
from memcomp_lightning.studies.few_labels.trial import LabelsTrial, PretrainingTrial

__all__ = [
    "Accuracies",
    "BatchNormRelu",
    "DenoisingAutoencoder",
    "FewLabels",
    "HiddenMeans",
    "LabelRbm",
    "LabelsTrial",
    "Network",
    "Pixels",
    "Pretrained",
    "PretrainingTrial",
    "PrincipalComponents",
    "PseudoLabels",
    "Regression",
    "SupportVectors",
    "read_few_labels",
]
