"""Where the data come from and how they reach the training: sources, batches, the Lightning data modules.

A source (:class:`Digits`, :class:`Mnist`, ...) is a frozen set of settings whose ``load`` returns an
:class:`ImageData`; :class:`Table` returns a :class:`TableData` and :class:`Sequences` a :class:`SequenceData`,
with the schema of what they hold. The data module of each deals them into replicas and batches.
"""

from memcomp_lightning.data.baselines import independent_log_likelihood, logistic_regression
from memcomp_lightning.data.idx import CorruptFileError
from memcomp_lightning.data.images import ImageData, ImageSource, PixelLayout
from memcomp_lightning.data.loading import Batches, SparseRows
from memcomp_lightning.data.module import ImageDataModule, RowsDataModule, TableDataModule
from memcomp_lightning.data.pixels import GreySource
from memcomp_lightning.data.reduce import SIX_BY_SIX_WITHOUT_CORNERS, reduce_images
from memcomp_lightning.data.sequences import SequenceData, Sequences, SequenceSchema
from memcomp_lightning.data.sources import BarsAndStripes, Digits, Mnist, ReducedMnist, ShiftingBars
from memcomp_lightning.optional import on_demand

__all__ = [
    "SIX_BY_SIX_WITHOUT_CORNERS",
    "BarsAndStripes",
    "Batches",
    "CorruptFileError",
    "Digits",
    "GreySource",
    "ImageData",
    "ImageDataModule",
    "ImageSource",
    "Mnist",
    "PixelLayout",
    "ReducedMnist",
    "RowsDataModule",
    "SequenceData",
    "SequenceSchema",
    "Sequences",
    "ShiftingBars",
    "SparseRows",
    "Table",
    "TableData",
    "TableDataModule",
    "TableSchema",
    "independent_log_likelihood",
    "logistic_regression",
    "reduce_images",
]

# They need Arrow, which is an extra.
__getattr__ = on_demand(__name__, dict.fromkeys(("Table", "TableData", "TableSchema"), "tables"))
