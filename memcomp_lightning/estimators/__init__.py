"""scikit-learn estimators: an RBM as a transformer, a deep belief network as a classifier.

Both take dense and sparse matrices and ``sample_weight``; :class:`MemcompRBM` says how inputs are scaled. Settings
of a sampler are set and searched like those of a step of a pipeline: ``set_params(sampler__k=5)``.
"""

from memcomp_lightning.estimators.classifier import MemcompDBNClassifier
from memcomp_lightning.estimators.rbm import MemcompRBM

__all__ = ["MemcompDBNClassifier", "MemcompRBM"]
