"""What is run from sweep to sweep: plain Gibbs chains, or ladders of temperatures."""

import math
from dataclasses import dataclass
from typing import Protocol, TypeVar

from torch import Generator, Tensor

from memcomp_lightning.models.base import Chains
from memcomp_lightning.samplers import ParallelTempering
from memcomp_lightning.samplers.parallel_tempering import Ladder, betas

StateT = TypeVar("StateT")

SWAP_RATE = 0.6
"""Accepted share of exchanges that a ladder is fitted to: about twice as many temperatures as there must be, which
makes the round trips fast (Syed, Bouchard-Cote, Deligiannidis & Doucet 2022)."""

HOT_ENOUGH = 0.05
"""Inverse temperature at which the chains of any model move freely."""

FEWEST, MOST = 8, 64
"""Temperatures of a ladder: as many of these as it takes."""

N_FAST, N_SLOW = 256, 64
"""Rounds in which a ladder is fitted, first in large steps and then in small ones."""


class Process(Protocol[StateT]):
    """Chains of one model at its own temperature, whatever helps them to move."""

    def begin(self, x: Tensor) -> StateT:
        """Start at these states, ``(n_chains, n_units)``."""

    def advance(self, state: StateT, *, generator: Generator) -> StateT:
        """One sweep."""

    def x_of(self, state: StateT) -> Tensor:
        """The states at the model's own temperature."""

    def renewals(self, state: StateT) -> float:
        """How often a chain forgot everything, and came back; infinite where none is meant to do that."""


@dataclass(frozen=True, eq=False)
class Gibbs:
    """Plain Gibbs chains.

    Attributes:
        chains: Of the model.
    """

    chains: Chains

    def begin(self, x: Tensor) -> Tensor:
        """The states themselves."""
        return x

    def advance(self, state: Tensor, *, generator: Generator) -> Tensor:
        """Draw every unit once."""
        return self.chains.sweep(state, generator=generator)

    def x_of(self, state: Tensor) -> Tensor:
        """The states."""
        return state

    def renewals(self, state: Tensor) -> float:
        """Infinite: chains go on for ever."""
        return math.inf


@dataclass(frozen=True, eq=False)
class Tempering:
    """Ladders of temperatures that stay as they are, which leaves the distribution exactly invariant.

    Attributes:
        chains: Of the model.
        gap: Differences of inverse temperature, ``(n_temperatures - 1,)``.
    """

    chains: Chains
    gap: Tensor

    @property
    def n_temperatures(self) -> int:
        """Steps of a ladder."""
        return len(self.gap) + 1

    def begin(self, x: Tensor) -> Ladder:
        """A ladder for each state, which stands on all its steps: ladders begin as far apart as the states."""
        ladder = self._sampler.ladder(_on_all_steps(x, self.n_temperatures))
        return ladder._replace(gap=self.gap)

    def advance(self, state: Ladder, *, generator: Generator) -> Ladder:
        """A sweep at all temperatures, and exchanges between neighbours."""
        return self._sampler.advanced(self.chains, state, generator=generator)

    def x_of(self, state: Ladder) -> Tensor:
        """The coldest states."""
        return state.x[0]

    def renewals(self, state: Ladder) -> float:
        """Round trips to the hottest temperature and back, a ladder."""
        return float(state.round_trips) / state.last_end.shape[-1]

    @property
    def _sampler(self) -> ParallelTempering:
        return ParallelTempering(n_temperatures=self.n_temperatures, adaptation=0.0)


def fitted(chains: Chains, x: Tensor, *, generator: Generator) -> tuple[Tempering, Ladder, int]:
    """Fit a ladder: so many temperatures, equally easy to pass, that the hottest one is hot.

    Returns:
        Ladders with the temperatures that were found, their states, which began at x ``(n, n_units)``, and the
        rounds that it took.
    """
    n_temperatures, n_all = FEWEST, 0
    while True:
        state = ParallelTempering(n_temperatures=n_temperatures).ladder(_on_all_steps(x, n_temperatures))
        for n_rounds, adaptation in ((N_FAST, 0.3), (N_SLOW, 0.1)):
            sampler = ParallelTempering(
                n_temperatures=n_temperatures, target_swap_rate=SWAP_RATE, adaptation=adaptation
            )
            for _ in range(n_rounds):
                state = sampler.advanced(chains, state, generator=generator)
        n_all += N_FAST + N_SLOW
        if float(betas(state.gap)[-1]) <= HOT_ENOUGH or n_temperatures >= MOST:
            break
        n_temperatures *= 2
    n = _n_different(state.gap)
    found = Tempering(chains, state.gap[: n - 1])
    # Trips and rates are counted from here on.
    return found, found.begin(x)._replace(x=state.x[:n]), n_all


def _on_all_steps(x: Tensor, n_temperatures: int) -> Tensor:
    return x.expand(n_temperatures, *x.shape).contiguous()


def _n_different(gap: Tensor) -> int:
    """Temperatures up to the first infinite one, two at least."""
    infinite = (betas(gap) == 0).nonzero().flatten()
    return max(2, int(infinite[0]) + 1) if len(infinite) else len(gap) + 1
