"""What studies measure of trained models; a measure is a file here and a line of the table."""

from collections.abc import Mapping

from memcomp_lightning.studies.measures.ais import ais
from memcomp_lightning.studies.measures.base import MakeMeasure, Measure, Scores
from memcomp_lightning.studies.measures.kl import kl
from memcomp_lightning.studies.measures.log_likelihood import log_likelihood

MEASURES: Mapping[str, MakeMeasure] = {"kl": kl, "log_likelihood": log_likelihood, "ais": ais}
"""By the names that ``worth.data_sets.NAME.measure`` takes."""

__all__ = ["MEASURES", "MakeMeasure", "Measure", "Scores"]
