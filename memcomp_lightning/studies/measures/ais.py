"""Log-likelihood by annealed importance sampling in both directions."""

from memcomp_lightning.data import ImageDataModule
from memcomp_lightning.likelihood import estimate_both_ways
from memcomp_lightning.models import EnergyModel
from memcomp_lightning.studies.measures.base import Measure, Scores, Scoring, negative_log_likelihood


def scoring(data: ImageDataModule, n_reported: int) -> Scoring:
    """Score by AIS, whose log Z tends to be too small, and by reverse AIS, whose log Z tends to be too large."""
    negative, v = negative_log_likelihood(data, n_reported), data.values_of(data.images.train_v)

    def measure(model: EnergyModel) -> Scores:
        both = estimate_both_ways(model, v)
        return Scores(negative(model, both.up.log_z), negative(model, both.down.log_z))

    return measure


AIS = Measure(scoring, "negative log-likelihood by AIS, nats", both_ways=True)
