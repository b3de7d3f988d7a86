"""What supplies the posterior of an RBM where values of the data are missing."""

from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.machine import log2_states
from memcomp_lightning.samplers.positive.base import PositivePhaseSampler
from memcomp_lightning.samplers.positive.clamped_gibbs import ClampedGibbs
from memcomp_lightning.samplers.positive.exact import ExactPosterior

MOST_SUMMED = 6
"""Hidden units of which all states are summed for each row: 2^6 configurations a row; with more they are drawn."""


def posterior_of(model: EnergyModel) -> PositivePhaseSampler:
    """Exact sums over few hidden units, Gibbs chains for more: missing values couple the hidden units."""
    few = not model.hidden.real and log2_states(model.hidden) <= MOST_SUMMED
    return ExactPosterior() if few else ClampedGibbs()
