"""Settings and passes that cross-validation inside the labelled rows chooses."""

import math
from typing import NamedTuple

from memcomp_lightning.studies.few_labels.data import Sets
from memcomp_lightning.studies.few_labels.learner import Context, Learner, Point
from memcomp_lightning.studies.search import Axes, Setting, best_of, missing, text_of


class Chosen(NamedTuple):
    """What cross-validation chose.

    Attributes:
        setting: With a value for each axis.
        passes: Of training; 0 of a method without.
        accuracy: Mean over folds.
        tried: Settings.
    """

    setting: Setting
    passes: int
    accuracy: float
    tried: int


def cross_validated(learner: Learner, context: Context, folds: Sets, axes: Axes, start: Setting) -> Chosen:
    """Walk uphill on each axis, see :mod:`memcomp_lightning.studies.search`; each setting has its best passes."""
    judged, best = dict[str, float](), dict[str, Point]()
    while asked := missing(axes, start, judged):
        for setting in asked:
            points = learner.learn(context, folds, setting, None)
            key, found = text_of(setting), max(points, key=lambda point: point.value, default=None)
            judged[key] = -math.inf if found is None else found.value
            if found is not None:
                best[key] = found
    setting = best_of(axes, start, judged)
    point = best.get(text_of(setting))
    if point is None:
        return Chosen(setting, 1, math.nan, len(judged))
    return Chosen(setting, point.passes, float(point.accuracy.mean()), len(judged))
