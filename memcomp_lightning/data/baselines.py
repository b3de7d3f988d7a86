"""What simple models reach on the same data: the numbers to compare a trained network with."""

import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning.data.mnist_files import cache_folder

MOST_IMAGES = 20_000
MOST_NUMBERS = 2_400_000
"""Images, and inputs of all of them, that logistic regression is fitted to at most: about a second."""


def n_fitted(v: Tensor) -> int:
    """Images that :func:`logistic_regression` is fitted to: the first ones, as many as take about a second."""
    return min(v.shape[-2], MOST_IMAGES, max(1, MOST_NUMBERS // v.shape[-1]))


def logistic_regression(train: tuple[Tensor, Tensor], test: tuple[Tensor, Tensor]) -> float:
    """Share of test images that scikit-learn's logistic regression on the inputs themselves classifies correctly.

    It is fitted to the first :func:`n_fitted` training images, once: the result is kept in the cache folder.

    Args:
        train: Intensities ``(n, n_visible)`` and labels ``(n,)``.
        test: The same of the test images.
    """
    from joblib import Memory  # with scikit-learn half a second, which not every command needs

    n = n_fitted(train[0])
    arrays = [tensor.numpy(force=True) for tensor in (train[0][:n], train[1][:n], *test)]
    try:
        return float(Memory(cache_folder(), verbose=0).cache(_fit_and_score)(*arrays))
    except (OSError, RuntimeError):  # no home, or one that cannot be written to: a second again the next time
        return _fit_and_score(*arrays)


def independent_log_likelihood(train_v: Tensor, v: Tensor) -> float:
    """Mean log-likelihood of images, in nats, under independent units with the means of the training images.

    Intensities between 0 and 1 are probabilities of a 1; the mean over their draws is taken. The means count one
    more image with the unit on and one with it off, so that no probability is 0.

    Args:
        train_v: ``(n, n_visible)``.
        v: The images to judge, ``(n_judged, n_visible)``.
    """
    mean = (train_v.double().sum(-2) + 1) / (train_v.shape[-2] + 2)
    log_on, log_off = mean.log(), torch.log1p(-mean)
    return float((v.double() @ (log_on - log_off)).mean() + log_off.sum())


def _fit_and_score(
    train_v: NDArray[np.generic],
    train_label: NDArray[np.generic],
    test_v: NDArray[np.generic],
    test_label: NDArray[np.generic],
) -> float:
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.linear_model import LogisticRegression

    if len(np.unique(train_label)) == 1:
        return float((test_label == train_label[0]).mean())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)
        return float(LogisticRegression(max_iter=100).fit(train_v, train_label).score(test_v, test_label))
