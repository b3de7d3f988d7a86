"""scikit-learn estimators: an RBM as a transformer, a deep belief network as a classifier.

Both take dense and sparse matrices, and ``sample_weight``. Arithmetic is done, and results are returned, in the
input's own precision, float32 or float64. A column that is within [0, 1] in ``fit`` is left as it is. One that
is not is scaled to [0, 1] by its range; if it is constant, it becomes 0 (below 0) or 1 (above 1). Later values
beyond [0, 1] are clipped. Settings of a sampler are set and searched like those of a step of a pipeline:
``set_params(sampler__k=5)``.
"""

from memcomp_lightning.estimators.classifier import MemcompDBNClassifier
from memcomp_lightning.estimators.rbm import MemcompRBM

__all__ = ["MemcompDBNClassifier", "MemcompRBM"]
