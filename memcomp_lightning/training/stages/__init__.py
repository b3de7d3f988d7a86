"""Ways of pretraining, one file each: which energy models are trained one after the other, and on what."""

from memcomp_lightning.training.stages.base import Phase, PretrainingStage
from memcomp_lightning.training.stages.boltzmann import Boltzmann
from memcomp_lightning.training.stages.greedy import Greedy
from memcomp_lightning.training.stages.joint import Joint

__all__ = ["Boltzmann", "Greedy", "Joint", "Phase", "PretrainingStage"]
