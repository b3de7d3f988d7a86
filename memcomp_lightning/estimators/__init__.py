"""scikit-learn estimators: an RBM as a transformer, a deep belief network as a classifier.

Both take dense and sparse matrices, and ``sample_weight``. Arithmetic is done, and results are returned, in the
input's own precision, float32 or float64. Columns within [0, 1] are left as they are; one that leaves [0, 1] is
scaled to it by its range in ``fit``, and a constant one outside counts as 0 below and as 1 above. Later values
beyond [0, 1] are clipped. Settings of a sampler are set and searched like those of a step of a pipeline:
``set_params(sampler__k=5)``.
"""

from memcomp_lightning.estimators.classifier import MemcompDBNClassifier
from memcomp_lightning.estimators.rbm import MemcompRBM

__all__ = ["MemcompDBNClassifier", "MemcompRBM"]
