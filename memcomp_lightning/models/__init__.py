"""Energy models and networks, each a ``torch.nn.Module`` on the replica axis."""

from memcomp_lightning.models.dbn import DBN
from memcomp_lightning.models.feedforward import BatchNorm, BatchNormReluNetwork, Linear, with_batch_norm_relu
from memcomp_lightning.models.init import Gaussian, Initialiser, Uniform, Xavier
from memcomp_lightning.models.randomise import GaussianMoments, Randomiser, Shuffled
from memcomp_lightning.models.rbm import RBM

__all__ = [
    "DBN",
    "RBM",
    "BatchNorm",
    "BatchNormReluNetwork",
    "Gaussian",
    "GaussianMoments",
    "Initialiser",
    "Linear",
    "Randomiser",
    "Shuffled",
    "Uniform",
    "Xavier",
    "with_batch_norm_relu",
]
