"""Training many small networks as one tensor program, without a trainer: the same numbers as the modules."""

from memcomp_lightning.replicas.stack import stacked
from memcomp_lightning.replicas.training import (
    Pass,
    Rates,
    finetune,
    pretrain,
    pretrain_jointly,
    pretrain_layer,
    pretrain_machine,
)

__all__ = [
    "Pass",
    "Rates",
    "finetune",
    "pretrain",
    "pretrain_jointly",
    "pretrain_layer",
    "pretrain_machine",
    "stacked",
]
