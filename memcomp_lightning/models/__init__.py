"""Energy models and networks, each a ``torch.nn.Module`` on the replica axis."""

from memcomp_lightning.models.base import Block, Chains, EnergyModel, QuadraticForm, TwoLayers, as_two_layers
from memcomp_lightning.models.bit_form import BitForm, bit_form, descend, read_bits
from memcomp_lightning.models.boltzmann import BoltzmannMachine
from memcomp_lightning.models.couplings import Couplings, contact_scores, couplings
from memcomp_lightning.models.dbm import DBM
from memcomp_lightning.models.dbn import DBN
from memcomp_lightning.models.feedforward import BatchNorm, BatchNormReluNetwork, Linear, with_batch_norm_relu
from memcomp_lightning.models.gauge import zero_sum
from memcomp_lightning.models.generative import GenerativeDBN
from memcomp_lightning.models.init import Initialiser, Normal, Uniform, Xavier, independent_bias, start_at_means
from memcomp_lightning.models.mean_field import MeanFieldSolution, hidden_blocks, mean_field
from memcomp_lightning.models.parts import energy_models, joint_model
from memcomp_lightning.models.randomise import GaussianMoments, Randomiser, Shuffled
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.stack import stacked

__all__ = [
    "DBM",
    "DBN",
    "RBM",
    "BatchNorm",
    "BatchNormReluNetwork",
    "BitForm",
    "Block",
    "BoltzmannMachine",
    "Chains",
    "Couplings",
    "EnergyModel",
    "GaussianMoments",
    "GenerativeDBN",
    "Initialiser",
    "Linear",
    "MeanFieldSolution",
    "Normal",
    "QuadraticForm",
    "Randomiser",
    "Shuffled",
    "TwoLayers",
    "Uniform",
    "Xavier",
    "as_two_layers",
    "bit_form",
    "contact_scores",
    "couplings",
    "descend",
    "energy_models",
    "hidden_blocks",
    "independent_bias",
    "joint_model",
    "mean_field",
    "read_bits",
    "stacked",
    "start_at_means",
    "with_batch_norm_relu",
    "zero_sum",
]
