"""Log-likelihood by the exact partition function: smaller layers of up to 25 units."""

from typing import Any

from memcomp_lightning.likelihood import log_partition_function
from memcomp_lightning.studies.measures.base import Measure, Scores, negative_log_likelihood


def log_likelihood(data: Any, n_reported: int) -> Measure:
    """Exact."""
    negative = negative_log_likelihood(data, n_reported)
    return lambda rbm: Scores(negative(rbm, log_partition_function(rbm)))
