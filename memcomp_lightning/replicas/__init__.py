"""Training many small networks as one tensor program, without a trainer: the same numbers as the modules."""

from memcomp_lightning.replicas.stack import stacked
from memcomp_lightning.replicas.training import (
    Backpropagation,
    ContrastTraining,
    Pass,
    Rates,
    finetune,
    pretrain,
    pretrain_jointly,
    pretrain_layer,
    pretrain_machine,
    require_finite,
)

__all__ = [
    "Backpropagation",
    "ContrastTraining",
    "Pass",
    "Rates",
    "finetune",
    "pretrain",
    "pretrain_jointly",
    "pretrain_layer",
    "pretrain_machine",
    "require_finite",
    "stacked",
]
