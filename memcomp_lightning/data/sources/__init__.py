"""Where images come from: one source a file, the options of the group ``data``."""

from memcomp_lightning.data.sources.bars_and_stripes import BarsAndStripes
from memcomp_lightning.data.sources.digits import Digits
from memcomp_lightning.data.sources.mnist import Mnist
from memcomp_lightning.data.sources.reduced_mnist import ReducedMnist
from memcomp_lightning.data.sources.shifting_bars import ShiftingBars

__all__ = ["BarsAndStripes", "Digits", "Mnist", "ReducedMnist", "ShiftingBars"]
