"""Parallel tempering: chains at several temperatures that exchange their states."""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import Chains, EnergyModel
from memcomp_lightning.types import Configurations, NegativePhase


class Ladder(NamedTuple):
    """Chains at all temperatures, from the coldest (beta = 1) to the hottest.

    Attributes:
        x: States, ``(*replicas, n_temperatures, n_chains, n_units)``: see ``models.base.Chains``.
        gap: Difference of inverse temperature between neighbours, ``(*replicas, n_temperatures - 1)``.
        swap_rate: Running mean of the accepted share of exchanges, ``(*replicas, n_temperatures - 1)``.
        last_end: The end of the ladder that a state was at last: 1 the coldest, -1 the hottest, 0 none yet;
            ``(*replicas, n_temperatures, n_chains)``.
        round_trips: Journeys from the coldest to the hottest and back, of all states, ``(*replicas,)``.
        n_rounds: Rounds of exchanges so far, a scalar.
    """

    x: Tensor
    gap: Tensor
    swap_rate: Tensor
    last_end: Tensor
    round_trips: Tensor
    n_rounds: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class ParallelTempering:
    """Persistent chains that mix better than those of PCD, because they exchange states with hotter chains.

    Inverse temperatures are 1 = beta_0 > ... > beta_{T-1} >= 0; the coldest chains are returned.
    After each sweep neighbours exchange their states with probability
    ``min(1, exp((beta_i - beta_j) (E_i - E_j)))``, even and odd pairs in turn, which leaves the product of all
    ``exp(-beta E) / Z(beta)`` invariant (Desjardins et al. 2010; Cho et al. 2010). The gaps between the
    temperatures follow the accepted share of exchanges towards ``target_swap_rate``; the hottest temperature is
    not set but follows from the gaps, and is at most infinite.

    Attributes:
        k: Sweeps an update, >= 1.
        n_chains: Ladders a replica, >= 1; None takes as many as there are images in the batch.
        n_temperatures: Steps of a ladder, >= 2.
        target_swap_rate: Accepted share of exchanges that the gaps are led to, in (0, 1).
        adaptation: How fast gaps follow: log gap changes by this times (accepted share - target), >= 0; 0 keeps
            the gaps equal.
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = False

    k: int = 1
    n_chains: int | None = 100
    n_temperatures: int = 10
    target_swap_rate: float = 0.5
    adaptation: float = 0.1

    def __post_init__(self) -> None:
        require_count("k", self.k)
        if self.n_chains is not None:
            require_count("n_chains", self.n_chains)
        require_count("n_temperatures", self.n_temperatures, minimum=2)
        rate = self.target_swap_rate
        require(0 < rate < 1, "target_swap_rate", rate, "a number between 0 and 1")
        require(self.adaptation >= 0, "adaptation", self.adaptation, "a number >= 0")

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> Ladder:
        """Start all chains at random states and the gaps equal."""
        n = self.n_chains or n_chains
        x = model.chains().random(self.n_temperatures * n, generator=generator)
        return self.ladder(x.unflatten(-2, (self.n_temperatures, n)))

    def ladder(self, x: Tensor) -> Ladder:
        """Ladders of these states, ``(*replicas, n_temperatures, n_chains, n_units)``, with equal gaps."""
        *replicas, n_temperatures, n, _ = x.shape
        gap = x.new_full((*replicas, n_temperatures - 1), 1.0 / (n_temperatures - 1))
        return Ladder(
            x=x,
            gap=gap,
            swap_rate=torch.full_like(gap, self.target_swap_rate),
            last_end=torch.zeros((*replicas, n_temperatures, n), dtype=torch.float32, device=x.device),
            round_trips=torch.zeros(replicas, dtype=torch.float32, device=x.device),
            n_rounds=torch.zeros((), dtype=torch.long, device="cpu"),
        )

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: Ladder, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[Ladder]:
        """Return the coldest configuration of each ladder."""
        chains = model.chains()
        for _ in range(self.k):
            state = self.advanced(chains, state, generator=generator)
        info = {
            "swap_rate": state.swap_rate.mean(-1),
            "swap_rate_lowest": state.swap_rate.amin(-1),
            "beta_hottest": betas(state.gap)[..., -1],
            "round_trips": state.round_trips.clone(),
        }
        return NegativePhase(chains.read(state.x[..., 0, :, :].clone()), state, info)

    def advanced(self, chains: Chains, state: Ladder, *, generator: Generator) -> Ladder:
        """A sweep at every temperature, and exchanges of every second pair of neighbours."""
        shape, beta = state.x.shape, betas(state.gap)
        n_chains = shape[-2]
        every = beta.repeat_interleave(n_chains, dim=-1).unsqueeze(-1)
        x, energy = chains.swept_with_energy(state.x.flatten(-3, -2), beta=every, generator=generator)
        energy = energy.unflatten(-1, (-1, n_chains))
        first = int(state.n_rounds) % 2
        cold, hot = slice(first, shape[-3] - 1, 2), slice(first + 1, None, 2)
        if energy[..., cold, :].shape[-2] == 0:  # two temperatures have no odd pair
            return state._replace(x=x.view(shape), n_rounds=state.n_rounds + 1)
        log_ratio = (beta[..., cold] - beta[..., hot]).unsqueeze(-1) * (energy[..., cold, :] - energy[..., hot, :])
        draw = rng.uniform(log_ratio.shape, generator=generator, like=log_ratio)
        swaps = draw < log_ratio.exp()
        x, last_end = _exchanged(x.view(shape), swaps.unsqueeze(-1), cold, hot), state.last_end
        last_end = _exchanged(last_end.unsqueeze(-1), swaps.unsqueeze(-1), cold, hot).squeeze(-1)
        home = last_end[..., 0, :] == -1
        # At the hottest temperature, states that came from the coldest one are on their way back.
        last_end[..., -1, :] = torch.where(last_end[..., -1, :] == 0, last_end[..., -1, :], -1.0)
        last_end[..., 0, :] = 1.0
        return self._adapted(state, swaps.to(x.dtype).mean(-1), cold)._replace(
            x=x,
            last_end=last_end,
            round_trips=state.round_trips + home.sum(-1),
            n_rounds=state.n_rounds + 1,
        )

    def _adapted(self, state: Ladder, accepted: Tensor, pairs: slice) -> Ladder:
        """Wider gaps where more is accepted than asked for, narrower ones where less is."""
        swap_rate, gap = state.swap_rate.clone(), state.gap.clone()
        swap_rate[..., pairs] = swap_rate[..., pairs].lerp(accepted, 0.1)
        change = self.adaptation * (accepted - self.target_swap_rate)
        gap[..., pairs] = (gap[..., pairs] * change.exp()).clamp(1e-6, 1.0)
        return state._replace(swap_rate=swap_rate, gap=gap)


def betas(gap: Tensor) -> Tensor:
    """Inverse temperatures of a ladder, ``(*replicas, n_temperatures)``: 1 less the gaps, not below 0."""
    below = (1 - gap.cumsum(-1)).clamp_min(0.0)
    return torch.cat((torch.ones_like(below[..., :1]), below), dim=-1)


def _exchanged(x: Tensor, swaps: Tensor, cold: slice, hot: slice) -> Tensor:
    """``(*replicas, n_temperatures, n_chains, n)`` with some neighbours exchanged."""
    x = x.clone()
    x[..., cold, :, :], x[..., hot, :, :] = (
        torch.where(swaps, x[..., hot, :, :], x[..., cold, :, :]),
        torch.where(swaps, x[..., cold, :, :], x[..., hot, :, :]),
    )
    return x
