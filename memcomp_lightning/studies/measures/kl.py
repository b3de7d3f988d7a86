"""Divergence of the data set from the model, where the data set is all that there is to know."""

from typing import Any

from memcomp_lightning.likelihood import kl_divergence
from memcomp_lightning.studies.measures.base import Measure, Scores


def kl(data: Any, n_reported: int) -> Measure:
    """The data set itself, which every replica learns from."""
    v = data.images.train_v
    return lambda rbm: Scores(kl_divergence(rbm, v))
