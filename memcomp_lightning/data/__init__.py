"""Where the images come from and how they reach the training: sources, batches, the Lightning data module.

A source (:class:`Digits`, :class:`Mnist`, ...) is a frozen set of settings whose ``load`` returns an
:class:`ImageData`; :class:`ImageDataModule` deals that into replicas and batches.
"""

from memcomp_lightning.data.baselines import independent_log_likelihood, logistic_regression
from memcomp_lightning.data.idx import CorruptFileError
from memcomp_lightning.data.images import ImageData, ImageSource, PixelLayout
from memcomp_lightning.data.loading import Batches, SparseRows
from memcomp_lightning.data.module import ImageDataModule
from memcomp_lightning.data.pixels import GreySource
from memcomp_lightning.data.reduce import SIX_BY_SIX_WITHOUT_CORNERS, reduce_images
from memcomp_lightning.data.sources import BarsAndStripes, Digits, Mnist, ReducedMnist, ShiftingBars

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
    "ShiftingBars",
    "SparseRows",
    "independent_log_likelihood",
    "logistic_regression",
    "reduce_images",
]
