"""Training many small networks as one tensor program, without a trainer: the same numbers as the modules."""

from memcomp_lightning.replicas.stack import stacked
from memcomp_lightning.replicas.training import Rates, finetune, pretrain, pretrain_layer

__all__ = ["Rates", "finetune", "pretrain", "pretrain_layer", "stacked"]
