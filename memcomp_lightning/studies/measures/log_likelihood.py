"""Log-likelihood by the exact partition function: smaller layers of up to 25 units."""

from memcomp_lightning.data import ImageDataModule
from memcomp_lightning.likelihood import log_partition_function
from memcomp_lightning.studies.measures.base import Measure, Scores, Scoring, negative_log_likelihood


def scoring(data: ImageDataModule, n_reported: int) -> Scoring:
    """Exact."""
    negative = negative_log_likelihood(data, n_reported)
    return lambda model: Scores(negative(model, log_partition_function(model)))


LOG_LIKELIHOOD = Measure(scoring, "negative log-likelihood, nats", is_exact=True)
