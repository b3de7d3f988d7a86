"""KL divergence of the data from the model, for data sets that are their whole distribution."""

from memcomp_lightning.data import ImageDataModule
from memcomp_lightning.likelihood import kl_divergence
from memcomp_lightning.studies.measures.base import Measure, Scores, Scoring


def scoring(data: ImageDataModule, n_reported: int) -> Scoring:
    """By the data set itself, which every replica learns from."""
    v = data.values_of(data.images.train_v)
    return lambda model: Scores(kl_divergence(model, v))


KL = Measure(scoring, "KL divergence of the data, nats", is_exact=True, is_divergence=True)
