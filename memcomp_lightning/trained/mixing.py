"""Do Markov chains mix: autocorrelation, R-hat and effective sample size of what was recorded along them."""

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtri

Series = Float[np.ndarray, "*rows n_chains n_draws n_statistics"]
"""Numbers recorded along several chains, at the same times.

Leading axes are for chains of several distributions, in numbers of one scale: chains are compared within each of
them, and variances are means over all.
"""

PerStatistic = Float[np.ndarray, " n_statistics"]
"""One number a statistic."""


def autocorrelation_time(series: Series) -> PerStatistic:
    r"""Integrated autocorrelation time :math:`\tau = 1 + 2 \sum_{t \ge 1} \rho(t)`, in steps of the series.

    The correlations are those of all chains together, from the variance within chains (W) and of their means:

    .. math:: \rho(t) = 1 - \frac{W - \bar C(t)}{V}, \qquad V = \frac{n - 1}{n} W + \mathrm{var}(\text{means})

    with the mean autocovariance C(t) of the chains (Vehtari et al. 2021, eq. 10), so that chains that each stay
    where they began count as correlated for ever. The sum ends by Geyer's rule: sums of two neighbours are
    positive and fall (initial monotone sequence; Geyer 1992).

    Args:
        series: At least 4 draws.

    Returns:
        1 for independent draws, below 1 where they alternate; of what never changes 1 if it is the same in all
        chains, and about twice ``n_draws`` if it is not.
    """
    n_draws = series.shape[-2]
    deviation = series - series.mean(axis=-2, keepdims=True)
    size = next_fast_len(2 * n_draws, real=True)
    spectrum = np.abs(rfft(deviation, size, axis=-2)) ** 2
    covariance = irfft(spectrum, size, axis=-2)[..., :n_draws, :] / (n_draws - 1)
    covariance = covariance.reshape(-1, *covariance.shape[-2:]).mean(axis=0)
    within, total = _variances(series)
    changes = total > 0
    rho = np.where(changes, 1 - (within - covariance) / np.where(changes, total, 1.0), 0.0)
    rho[0] = 1.0
    n_pairs = n_draws // 2
    pairs = rho[: 2 * n_pairs].reshape(n_pairs, 2, -1).sum(axis=1)
    positive = np.logical_and.accumulate(pairs > 0, axis=0)
    falling = np.minimum.accumulate(pairs, axis=0)
    time: PerStatistic = np.maximum(2 * np.where(positive, falling, 0.0).sum(axis=0) - 1, 1 / n_draws)
    return time


def effective_sample_size(series: Series) -> PerStatistic:
    """How many independent draws give means as sure as these: all draws over the autocorrelation time."""
    n_draws = series[..., 0].size
    return n_draws / autocorrelation_time(series)


def split_r_hat(series: Series) -> PerStatistic:
    r"""Rank-normalised split :math:`\hat R`: 1 if all chains, and both halves of each, have one distribution.

    .. math:: \hat R = \sqrt{V / W}

    of the halves of the chains, after each number is replaced by the normal quantile of its rank among all: the
    larger of that of the numbers, which sees other places, and that of their distances from the median, which sees
    other spreads (Vehtari, Gelman, Simpson, Carpenter & Bürkner 2021, Bayesian Analysis 16, 667). To ranks one
    chain among a hundred means little, however far off it is: so that of the numbers themselves counts as well,
    if it is larger still. With an autocorrelation time tau and n draws it is about sqrt(1 + 2 (tau - 1) / n).

    It sees what chains have visited: a place that none of them found changes nothing.

    Args:
        series: At least 4 draws.

    Returns:
        1 for what never changes and is the same in all chains; infinity if it is not the same.
    """
    half = series.shape[-2] // 2
    halves = np.concatenate((series[..., :half, :], series[..., -half:, :]), axis=-3)
    folded = np.abs(halves - np.median(halves, axis=(-3, -2), keepdims=True))
    found = (_r_hat(_normal_scores(halves)), _r_hat(_normal_scores(folded)), _r_hat(halves))
    largest: PerStatistic = np.max(found, axis=0)
    return largest


def _variances(series: Series) -> tuple[PerStatistic, PerStatistic]:
    """Mean variance within chains, and that of all chains together."""
    n_chains, n_draws, n_statistics = series.shape[-3:]
    series = series.reshape(-1, n_chains, n_draws, n_statistics)
    within = series.var(axis=2, ddof=1).mean(axis=(0, 1))
    means = series.mean(axis=2)
    of_means = means.var(axis=1, ddof=1).mean(axis=0) if n_chains > 1 else np.zeros(n_statistics)
    # What is left of rounding, where nothing changes.
    least = 1e-20 * np.abs(series).max(axis=(0, 1, 2)) ** 2
    within = np.where(within > least, within, 0.0)
    return within, (n_draws - 1) / n_draws * within + np.where(of_means > least, of_means, 0.0)


def _r_hat(series: Series) -> PerStatistic:
    within, total = _variances(series)
    with np.errstate(divide="ignore", invalid="ignore"):
        found: PerStatistic = np.where(total > 0, np.sqrt(total / within), 1.0)
    return found


def _normal_scores(series: Series) -> NDArray[np.float64]:
    """Normal quantiles of the ranks, equal numbers having the mean of theirs."""
    flat = series.reshape(*series.shape[:-3], -1, series.shape[-1])
    ranks = np.apply_along_axis(_ranks, -2, flat)
    found: NDArray[np.float64] = ndtri((ranks - 0.375) / (flat.shape[-2] + 0.25)).reshape(series.shape)
    return found


def _ranks(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ranks from 1 (those of scipy.stats, whose import takes longer than all chains)."""
    order = np.argsort(numbers)
    first = np.flatnonzero(np.diff(numbers[order], prepend=np.nan))  # of numbers that are equal; NaN differs
    counts = np.diff(first, append=len(numbers))
    ranks = np.empty(len(numbers))
    ranks[order] = np.repeat(first + (counts + 1) / 2, counts)
    return ranks
