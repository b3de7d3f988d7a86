"""Two learners of deeprob-kit: sum-product networks (LearnSPN), and ensembles of random cutset networks.

LearnSPN    R. Gens and P. Domingos, "Learning the structure of sum-product networks", ICML 2013
    ensembles   N. Di Mauro et al., "Random probabilistic circuits", UAI 2021: the package's XPC, deterministic and
                with Chow-Liu trees as leaves, which is a cutset network whose cuts are drawn; their mean is the
                ensemble
"""

import contextlib
import io
import warnings
from typing import Any

import numpy as np
from bits import Fitted, Real, Rows
from deeprob.spn.algorithms.inference import log_likelihood
from deeprob.spn.learning.wrappers import learn_estimator
from deeprob.spn.structure.leaf import Bernoulli
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components


def g_statistic(rows: NDArray[Any]) -> Real:
    """2 sum of observed log(observed / expected) of all pairs of binary columns, ``(n_visible, n_visible)``."""
    x = np.asarray(rows, np.float64)
    both, one = x.T @ x, x.sum(0)
    found = np.zeros_like(both)
    for a, b, seen in (
        (one, one, both),
        (one, len(x) - one, one[:, None] - both),
        (len(x) - one, one, one[None] - both),
        (len(x) - one, len(x) - one, len(x) - one[:, None] - one[None] + both),
    ):
        expected = np.outer(a, b) / len(x)
        with np.errstate(divide="ignore", invalid="ignore"):
            found += np.where(seen > 0, 2 * seen * np.log(seen / expected), 0.0)
    return found


def split_columns(
    rows: NDArray[Any], distributions: Any, domains: Any, generator: np.random.RandomState, p: float
) -> NDArray[np.int64]:
    """The columns that a chain of dependent pairs joins to a random one, against the others.

    That is deeprob's "gvs" with the same threshold, G < 2 p. It counts each pair in a histogram of its own, and
    then LearnSPN takes 27 s on nltcs; by one matrix product it takes half a second.
    """
    dependent = g_statistic(rows) >= 2 * p
    _, label = connected_components(dependent, directed=False)
    return (label == label[generator.randint(rows.shape[1])]).astype(np.int64)


def _log_likelihood_of(root: Any) -> Any:
    def of(rows: Rows) -> Real:
        with np.errstate(divide="ignore"):
            return np.asarray(log_likelihood(root, rows.astype(np.float32)), np.float64).reshape(-1)

    return of


def sum_product(
    train: Rows, valid: Rows, *, seed: int, leaf: str, threshold: float, min_rows: int, smoothing: float
) -> Fitted:
    """Rows are split by k-means in two, columns by independence, until fewer than ``min_rows`` are left."""
    n = train.shape[1]
    root = learn_estimator(
        train.astype(np.float32),
        [Bernoulli] * n,
        [[0, 1]] * n,
        learn_leaf=leaf,
        learn_leaf_kwargs={"alpha": smoothing},
        split_rows="kmeans",
        split_cols=split_columns,
        split_cols_kwargs={"p": threshold},
        min_rows_slice=min_rows,
        random_state=seed,
        verbose=False,
    )
    return Fitted(_log_likelihood_of(root))


def cutset_ensemble(
    train: Rows, valid: Rows, *, seed: int, min_rows: int, networks: int, cut: int, smoothing: float
) -> Fitted:
    """``networks`` random cutset networks of equal weight; a node cuts by the values of ``cut`` columns."""
    n = train.shape[1]
    # The package shuffles columns with numpy's global generator, and prints its progress.
    np.random.seed(seed)  # noqa: NPY002, TID251
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        root = learn_estimator(
            train.astype(np.float32),
            [Bernoulli] * n,
            [[0, 1]] * n,
            method="ensemble-xpc",
            ensemble_dim=networks,
            det=True,
            sd_level=0,
            min_part_inst=min_rows,
            conj_len=cut,
            arity=2,
            alpha=smoothing,
            random_seed=seed,
        )
    return Fitted(_log_likelihood_of(root))
