"""How models are trained: updates, stages and schedules, and loops that need no Lightning trainer."""

from memcomp_lightning.training.backprop import ClassifierStep
from memcomp_lightning.training.best import JUDGED_BY, BestPass
from memcomp_lightning.training.diverged import DivergedError, diverged_parameter, require_finite
from memcomp_lightning.training.dropout import Dropout
from memcomp_lightning.training.kept import kept_of, state_of
from memcomp_lightning.training.loops import Batches, ClassifierTraining, Pass, PhaseTraining, finetune, pretrain
from memcomp_lightning.training.losses import LOSSES, ClassWeighted, Loss, balanced, cross_entropy, squared_error
from memcomp_lightning.training.penalties import L1, L2, GroupSparsity, Penalty
from memcomp_lightning.training.schedules import (
    FINETUNING_SGD,
    PRETRAINING_SGD,
    LearningRateDecay,
    MomentumSchedule,
    OptimizerFactory,
    Schedule,
)
from memcomp_lightning.training.score import Score, evaluate, score
from memcomp_lightning.training.stages import Boltzmann, Greedy, Joint, Phase, PretrainingStage
from memcomp_lightning.training.step import EnergyStep, Processes, Sampler, StepState
from memcomp_lightning.training.updown import UpDownLosses, UpDownStep, up_down

__all__ = [
    "FINETUNING_SGD",
    "JUDGED_BY",
    "L1",
    "L2",
    "LOSSES",
    "PRETRAINING_SGD",
    "Batches",
    "BestPass",
    "Boltzmann",
    "ClassWeighted",
    "ClassifierStep",
    "ClassifierTraining",
    "DivergedError",
    "Dropout",
    "EnergyStep",
    "Greedy",
    "GroupSparsity",
    "Joint",
    "LearningRateDecay",
    "Loss",
    "MomentumSchedule",
    "OptimizerFactory",
    "Pass",
    "Penalty",
    "Phase",
    "PhaseTraining",
    "PretrainingStage",
    "Processes",
    "Sampler",
    "Schedule",
    "Score",
    "StepState",
    "UpDownLosses",
    "UpDownStep",
    "balanced",
    "cross_entropy",
    "diverged_parameter",
    "evaluate",
    "finetune",
    "kept_of",
    "pretrain",
    "require_finite",
    "score",
    "squared_error",
    "state_of",
    "up_down",
]
