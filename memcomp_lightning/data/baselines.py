"""What simple models reach on the same data: the numbers to compare a trained network with."""

import copy
import warnings

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning.data.mnist_files import cache_folder
from memcomp_lightning.models import RBM, start_at_means
from memcomp_lightning.models.units import Bernoulli, Units

MOST_IMAGES = 20_000
MOST_NUMBERS = 2_400_000
"""Images, and inputs of all of them, that logistic regression is fitted to at most: about a second."""

AT_ONCE = 10_000
"""Images that are judged side by side: all of a large table would take gigabytes."""


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


@torch.no_grad()
def independent_log_likelihood(
    train_v: Tensor,
    v: Tensor,
    units: Units | None = None,
    *,
    train_observed: Tensor | None = None,
    observed: Tensor | None = None,
) -> float:
    """Mean log-likelihood of images, in nats, under independent units with the means of the training images.

    Intensities between 0 and 1 are probabilities of a 1; the mean over their draws is taken. The means count one
    more image of each value, so that no probability is 0; real units that are learned have the variances as well.

    Args:
        train_v: ``(n, n_visible)``.
        v: The images to judge, ``(n_judged, n_visible)``.
        units: Kind of the units; None is units in {0, 1}.
        train_observed: Where the training images are known, a mask; None is everywhere.
        observed: Where those to judge are.
    """
    units = Bernoulli(v.shape[-1]) if units is None else copy.deepcopy(units)
    alone = RBM(visible=units, n_hidden=1).double()
    start_at_means(alone, train_v.double(), train_observed)
    total, n = 0.0, v.shape[-2]
    for begin in range(0, n, AT_ONCE):
        rows = slice(begin, begin + AT_ONCE)
        total += float(_log_p(alone, v[rows], None if observed is None else observed[rows]).sum())
    return total / n


def _log_p(alone: RBM, v: Tensor, observed: Tensor | None) -> Tensor:
    """Of each image under the visible units by themselves."""
    v, bias = v.double(), alone.b.detach().unsqueeze(-2)
    log_p = alone.visible.site_sums(v * bias) - alone.visible.cumulant(bias)
    if observed is not None:
        v = torch.where(observed, v, 0.0)
        known = alone.visible.site_sums(observed.double()) > 0
        log_p = torch.where(known, log_p, 0.0)
    return log_p.sum(-1) - alone.visible.energy(v)


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
