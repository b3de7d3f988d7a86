"""What studies measure of trained models; a measure is a file here and a line of the table."""

from collections.abc import Mapping

from memcomp_lightning.studies.measures.ais import AIS
from memcomp_lightning.studies.measures.base import Measure, Scores, Scoring
from memcomp_lightning.studies.measures.kl import KL
from memcomp_lightning.studies.measures.log_likelihood import LOG_LIKELIHOOD

MEASURES: Mapping[str, Measure] = {"kl": KL, "log_likelihood": LOG_LIKELIHOOD, "ais": AIS}
"""By the names that ``worth.data_sets.NAME.measure`` takes."""

__all__ = ["MEASURES", "Measure", "Scores", "Scoring"]
