"""Aligned sequences: files whose letters become categories, one site a column of the alignment."""

from memcomp_lightning.data.sequences.schema import SequenceSchema
from memcomp_lightning.data.sequences.similarity import neighbours
from memcomp_lightning.data.sequences.source import SequenceData, Sequences

__all__ = ["SequenceData", "SequenceSchema", "Sequences", "neighbours"]
