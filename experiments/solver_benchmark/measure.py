"""From energies and seconds to success, time to solution, gaps, intervals and scaling."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

TOLERANCE = 1e-6
N_BOOTSTRAP = 2000


class Tally(NamedTuple):
    """What counts of one solver on one instance."""

    seconds_per_read: float
    n_successes: int
    n_reads: int


class Interval(NamedTuple):
    """An estimate with the central 95 % of its bootstrap distribution.

    ``mark`` is ">" where it is a bound from below (never a success), "<" where it is one from above.
    """

    value: float
    low: float
    high: float
    mark: str = ""


def tally(energies: Sequence[float], seconds: float, best: float) -> Tally:
    """Count the reads within a relative 1e-6 of the best energy."""
    found = np.asarray(energies) <= best + max(TOLERANCE * abs(best), 1e-9)
    return Tally(seconds / len(found), int(found.sum()), len(found))


def tts99(seconds_per_read: np.ndarray | float, success: np.ndarray | float) -> np.ndarray:
    """Time until a success with a probability of .99: t ln(.01) / ln(1 - p), at least one read."""
    success = np.clip(success, 0.0, 1.0)
    with np.errstate(divide="ignore"):
        n_reads = np.log(0.01) / np.log1p(-success)
    return np.asarray(seconds_per_read * np.maximum(n_reads, 1.0))


def estimate(tallies: Sequence[Tally]) -> tuple[np.ndarray, np.ndarray]:
    """TTS99 of each instance, and which are bounds from below: without a success in n reads, p < 3 / n (95 %)."""
    seconds, k, n = (np.array(column, dtype=float) for column in zip(*tallies, strict=True))
    return tts99(seconds, np.where(k > 0, k / n, np.minimum(3 / n, 1.0))), k == 0


def ranking(tallies: Sequence[Tally]) -> float:
    """Geometric mean of TTS99 with p = (k + 1/2) / (n + 1): settings without a success can be compared, too."""
    seconds, k, n = (np.array(column, dtype=float) for column in zip(*tallies, strict=True))
    return float(np.exp(np.log(tts99(seconds, (k + 0.5) / (n + 1))).mean()))


def bootstrap(tallies: Sequence[Tally], *, seed: int = 0, stream: int = 0) -> np.ndarray:
    """Resampled TTS99, ``(N_BOOTSTRAP, n_instances)``: instances with replacement, p from its posterior.

    The posterior is Beta(k + 1/2, n - k + 1/2) (Jeffreys): unlike resampled reads it never says p = 0. The
    instances drawn depend on the seed and their number alone, so that those of two solvers, with different
    streams for p, are paired.
    """
    seconds, k, n = (np.array(column, dtype=float) for column in zip(*tallies, strict=True))
    generator, posterior = np.random.default_rng(seed), np.random.default_rng([seed, stream, 1])
    shape = (N_BOOTSTRAP, len(tallies))
    drawn = generator.integers(len(tallies), size=shape)
    return tts99(seconds[drawn], posterior.beta(k[drawn] + 0.5, n[drawn] - k[drawn] + 0.5))


def family_tts(tallies: Sequence[Tally]) -> Interval:
    """Geometric mean over the instances."""
    values, censored = estimate(tallies)
    return _interval(np.log(values).mean(), np.log(bootstrap(tallies)).mean(1), ">" * bool(censored.any()))


def family_ratio(above: Sequence[Tally], below: Sequence[Tally]) -> Interval:
    """Geometric mean of the ratio of two solvers' TTS99 on the same instances."""
    (values, censored), (others, others_censored) = estimate(above), estimate(below)
    logs = np.log(bootstrap(above)).mean(1) - np.log(bootstrap(below, stream=1)).mean(1)
    mark = ">" * bool(censored.any()) + "<" * bool(others_censored.any())
    return _interval(np.log(values / others).mean(), logs, mark)


def _interval(log_value: float, logs: np.ndarray, mark: str) -> Interval:
    low, high = np.exp(np.quantile(logs, (0.025, 0.975)))
    return Interval(float(np.exp(log_value)), float(low), float(high), mark)


def success_rate(tallies: Sequence[Tally]) -> Interval:
    """Mean over the instances of the share of reads that succeed."""
    k, n = (np.array([tally[index] for tally in tallies], dtype=float) for index in (1, 2))
    generator = np.random.default_rng(0)
    drawn = generator.integers(len(tallies), size=(N_BOOTSTRAP, len(tallies)))
    means = generator.beta(k[drawn] + 0.5, n[drawn] - k[drawn] + 0.5).mean(1)
    return Interval(float((k / n).mean()), *(float(q) for q in np.quantile(means, (0.025, 0.975))))


def expected_gap(energies: Sequence[float], seconds: float, best: float, horizon: float) -> float:
    """Expected relative gap of the best of the reads that fit into ``horizon`` seconds; NaN if none does.

    With k reads drawn from the n measured ones (with replacement) the i-th lowest is the best with
    probability ((n - i) / n)^k - ((n - i - 1) / n)^k.
    """
    n = len(energies)
    k = int(horizon / (seconds / n))
    if k < 1:
        return float("nan")
    tail = (np.arange(n, -1, -1) / n) ** k
    gap = float(((np.sort(energies) - best) * (tail[:-1] - tail[1:])).sum() / max(abs(best), 1e-12))
    return gap if gap > 1e-12 else 0.0


class Fit(NamedTuple):
    """log TTS99 = intercept + slope x, with the slope's interval."""

    intercept: float
    slope: Interval


def scaling(sizes: Sequence[float], tallies: Sequence[Sequence[Tally]], *, power: bool) -> Fit:
    """Least squares of log TTS99 against n (``power``: against log n), all instances of all sizes alike.

    Args:
        sizes: One a family.
        tallies: The instances of each family. Sizes at which an instance was never solved are left out.
        power: Power law instead of exponential.
    """
    used = [(size, rows) for size, rows in zip(sizes, tallies, strict=True) if not estimate(rows)[1].any()]
    x = np.concatenate([np.full(len(rows), np.log(size) if power else size) for size, rows in used])
    y = np.log(np.concatenate([estimate(rows)[0] for _, rows in used]))
    resampled = np.log(
        np.concatenate([bootstrap(rows, seed=index) for index, (_, rows) in enumerate(used)], axis=1)
    )
    slopes, intercepts = np.polyfit(x, np.concatenate((y[None], resampled)).T, 1)
    low, high = np.quantile(slopes[1:], (0.025, 0.975))
    return Fit(float(intercepts[0]), Interval(float(slopes[0]), float(low), float(high)))
