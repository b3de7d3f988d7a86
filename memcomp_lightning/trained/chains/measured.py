"""Runs chains until they are known to mix, or known not to."""

import math
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator

from memcomp_lightning.trained.chains.processes import Process
from memcomp_lightning.trained.chains.watch import Watch
from memcomp_lightning.trained.mixing import autocorrelation_time, split_r_hat

StateT = TypeVar("StateT")

R_HAT = 1.05
"""Most that counts as mixed: chains as long as eighteen autocorrelation times, after as many that were left out.

(1.01 is for four chains, which must be long to be sure of anything; of many ones together this is enough.)
"""

N_RENEWALS = 2
"""Least number of round trips of a ladder in the part that is judged: R-hat is blind to a mode that ladders lost
while they began, and that they come back to on such trips alone."""

N_DRAWS = 256
"""States of each chain that are looked at, at equal distances, however long the chains are."""


@dataclass(frozen=True, eq=False)
class Measured(Generic[StateT]):
    """How chains mixed in their last part, all before being left out.

    Attributes:
        state: Of the chains, at the end.
        r_hat: The largest over the statistics.
        autocorrelation: The largest integrated autocorrelation time, in sweeps.
        n_sweeps: Of each chain, those that were left out among them.
        renewals: See :meth:`Process.renewals`, in that part.
    """

    state: StateT
    r_hat: float
    autocorrelation: float
    n_sweeps: int
    renewals: float

    @property
    def mixed(self) -> bool:
        """Whether the chains agree, and had reason to."""
        return self.r_hat <= R_HAT and self.renewals >= N_RENEWALS


def measured(
    process: Process[StateT],
    state: StateT,
    watch: Watch,
    *,
    n_chains_of_row: int,
    most_sweeps: int,
    generator: Generator,
) -> Measured[StateT]:
    """Run chains for longer and longer, until R-hat says that they mix or that they will not.

    Each part is twice as long as the one before, and is judged alone.

    Args:
        process: The chains.
        state: Their state.
        watch: What to record.
        n_chains_of_row: Chains that share what is known, side by side; others are compared within rows.
        most_sweeps: Of the last part.
        generator: Random stream.
    """
    stride, n_sweeps = 1, 0
    while True:
        found, before = [], process.renewals(state)
        for _ in range(N_DRAWS):
            for _ in range(stride):
                state = process.advance(state, generator=generator)
            found.append(watch(process.x_of(state)))
        n_sweeps += N_DRAWS * stride
        series = _by_rows(torch.stack(found, dim=1).numpy(), n_chains_of_row)
        r_hat = float(split_r_hat(series).max())
        time = stride * max(1.0, float(autocorrelation_time(series).max()))
        # R-hat squared less one falls as the inverse of the length.
        needed = N_DRAWS * stride * (r_hat**2 - 1) / (R_HAT**2 - 1)
        after = process.renewals(state)
        known = Measured(state, r_hat, time, n_sweeps, after if math.isinf(after) else after - before)
        if known.mixed or needed > most_sweeps or 2 * stride * N_DRAWS > most_sweeps:
            return known
        stride *= 2


def effective_share(autocorrelation: float, spacing: int, n_draws: int) -> float:
    """How many independent draws one draw of a chain is worth, in (0, 1].

    Of correlations that fall exponentially with this integrated time.

    Args:
        autocorrelation: Integrated time, in sweeps, >= 1.
        spacing: Sweeps between two draws.
        n_draws: Of the chain.
    """
    if n_draws == 1:
        return 1.0
    step = ((autocorrelation - 1) / (autocorrelation + 1)) ** spacing
    lags = np.arange(1, n_draws)
    return float(1 / (1 + 2 * ((1 - lags / n_draws) * step**lags).sum()))


def spacing_of(autocorrelation: float) -> int:
    """Sweeps after which draws are as good as independent: correlated by 2 % at most."""
    return math.ceil(2 * autocorrelation)


def _by_rows(series: NDArray[np.float64], n_chains_of_row: int) -> NDArray[np.float64]:
    """Series of each row, ``(n_rows, n_chains_of_row, n_draws, n_statistics)``, in its standard deviations.

    They are whole thousandths of them: ranks must not tell numbers apart that rounding alone does.
    """
    rows = series.reshape(-1, n_chains_of_row, *series.shape[1:])
    deviation = rows - rows.mean(axis=(1, 2), keepdims=True)
    spread = rows.std(axis=(1, 2), keepdims=True)
    changes = spread > 2e-6 * np.abs(series).max(axis=(0, 1))
    scaled = np.divide(deviation, spread, out=np.zeros_like(deviation), where=changes)
    rounded: NDArray[np.float64] = np.round(1000 * scaled)
    return rounded
