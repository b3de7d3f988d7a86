"""Missing values by Gibbs chains with the observed ones clamped."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.likelihood.missing.base import SHARES, Conditional, real_entries, width_of
from memcomp_lightning.likelihood.missing.ladders import Ladders
from memcomp_lightning.likelihood.missing.quantiles import mixture_quantile
from memcomp_lightning.models.base import EnergyModel

COMPONENTS = 32
"""Means of a chain that the quantiles of a real value are made of, evenly spaced over its sweeps."""

SMALLEST_VARIANCE = 1e-3
"""Variances below this count as this much: chains that differ by a thousandth of a probability have converged."""


class _Sums(NamedTuple):
    """Sums over the sweeps of a round, float64.

    Attributes:
        drawn: Of each half, of the values drawn, ``(2, n_rows, n_chains, n_visible)``.
        square: Of their squares.
        mean: Of the means from which they were drawn, over the chains as well, ``(n_rows, n_visible)``.
        components: Some of these means of real units, ``(n_rows, n_chains * kept, n_real)``.
    """

    drawn: Tensor
    square: Tensor
    mean: Tensor
    components: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class MissingChains:
    r"""Several Gibbs chains a row, until they agree.

    They begin at random, are cooled down in half as many sweeps as the first round has, and go on in rounds, each
    twice as long as the one before. A row whose chains agree in a round, by the split R-hat of all its missing
    values (Gelman et al. 2013; 1 is agreement), is done. From the second round on each chain is the coldest of a
    ladder of temperatures that exchange states (parallel tempering), because they leave modes that a plain chain
    stays in. What is told of a value are averages, over the sweeps of that round, of its mean given all other
    units: they vary less than counts of what was drawn (Rao-Blackwell). A real value has the mixture of the
    normal distributions that it was drawn from.

    Attributes:
        n_chains: Of each row, >= 2; as many as draws, where more of these are asked for.
        n_sweeps: Of the first round, an even number.
        most_sweeps: Of the last round at most.
        r_hat: What counts as agreement, > 1.
        n_temperatures: Of a ladder, from 1 to infinity; 1 is none.
    """

    n_chains: int = 8
    n_sweeps: int = 200
    most_sweeps: int = 1600
    r_hat: float = 1.05
    n_temperatures: int = 10

    def __post_init__(self) -> None:
        require_count("n_chains", self.n_chains, 2)
        require_count("n_sweeps", self.n_sweeps, 4)
        require(self.n_sweeps % 2 == 0, "n_sweeps", self.n_sweeps, "an even number")
        require_count("most_sweeps", self.most_sweeps, self.n_sweeps)
        require(self.r_hat > 1, "r_hat", self.r_hat, "a number > 1")
        require_count("n_temperatures", self.n_temperatures)

    def numbers_a_row(self, model: EnergyModel, m: int) -> int:
        """States, masks and fields of the chains, sums in double precision, and components."""
        kept = COMPONENTS * len(real_entries(model.visible))
        return max(self.n_chains, m) * (2 * self.n_temperatures * model.n_units + 8 * model.n_visible + 2 * kept)

    @torch.no_grad()
    def find(
        self, model: EnergyModel, v: Tensor, observed: Tensor, *, m: int = 0, generator: Generator
    ) -> Conditional:
        """What the chains say of the missing values; each draw is the last state of a chain of its own."""
        units, real = model.visible, real_entries(model.visible)
        n_chains = max(self.n_chains, m)
        ladders = Ladders.begun(model, v.to(model.b.dtype), observed, n_chains, generator)
        wide = v.double()
        nothing = torch.full((3, len(v), len(real)), torch.nan, dtype=torch.float64, device=v.device)
        found = Conditional(wide.clone(), nothing, wide.repeat(m, 1, 1), torch.full_like(wide[:, 0], torch.nan))
        n_first = self.n_sweeps // 2
        for sweep in range(n_first):
            ladders.sweep(generator, beta=(sweep + 1) / n_first)
        floor = _smallest_variance(model)
        rows, window = torch.arange(len(v), device=v.device), self.n_sweeps
        while len(rows):
            sums = _swept(ladders, window, real, generator)
            r_hat = _r_hat(sums, window // 2, floor).masked_fill(observed[rows], 1.0).amax(-1)
            last = 2 * window > self.most_sweeps
            done = (r_hat <= self.r_hat) | last
            at = rows[done]
            found.mean[at] = torch.where(observed[at], found.mean[at], sums.mean[done] / (window * n_chains))
            found.r_hat[at] = r_hat[done]
            found.draws[:, at] = ladders.visible()[done, :m].transpose(0, 1).double()
            for column, entry in enumerate(real.tolist()):
                missing = ~observed[at, entry]
                component = sums.components[done][missing][..., column].double()
                if len(component):
                    found.real[:, at[missing], column] = _of_mixture(component, width_of(units, entry))
            rows, ladders, window = rows[~done], ladders.of(~done), 2 * window
            if len(rows) and self.n_temperatures > 1 and len(ladders.betas) == 1:
                ladders = ladders.heated(self.n_temperatures)
                for sweep in range(n_first):
                    ladders.sweep(generator, first=sweep % 2)
        return found


def _of_mixture(component: Tensor, width: float) -> Tensor:
    """Standard deviation and both quantiles of values that are normal about each of some means, ``(3, n)``."""
    weight = component.new_full((1, component.shape[-1]), 1 / component.shape[-1])
    deviation = (width**2 + component.var(-1, correction=0)).sqrt()
    return torch.stack((deviation, *(mixture_quantile(weight, component, width, share) for share in SHARES)))


def _swept(ladders: Ladders, n_sweeps: int, real: Tensor, generator: Generator) -> _Sums:
    """Sweep all chains, and add up what they show."""
    n, n_rows, half = ladders.model.n_visible, ladders.n // ladders.n_chains, n_sweeps // 2
    drawn, square = ladders.x.new_zeros(2, 2, ladders.n, n, dtype=torch.float64)
    total, every = torch.zeros_like(drawn[0]), max(1, n_sweeps // COMPONENTS)
    kept: list[Tensor] = []
    for sweep in range(n_sweeps):
        means = ladders.sweep(generator, first=sweep % 2)
        now = ladders.x[: ladders.n, :n]
        drawn[sweep // half] += now
        square[sweep // half] += now.square()
        total += means
        if sweep % every == 0 and len(kept) < COMPONENTS:
            kept.append(means[:, real])
    components = torch.stack(kept, dim=1).view(n_rows, ladders.n_chains * len(kept), len(real))
    shape = (2, n_rows, ladders.n_chains, n)
    return _Sums(drawn.view(shape), square.view(shape), total.view(shape[1:]).sum(1), components)


def _smallest_variance(model: EnergyModel) -> Tensor:
    """What a variance within a chain counts as at least, of each visible entry."""
    curvature = model.visible.curvature
    floor = model.b.new_full((model.n_visible,), SMALLEST_VARIANCE, dtype=torch.float64)
    if curvature is None:
        return floor
    return torch.where(curvature > 0, SMALLEST_VARIANCE / curvature.double().clamp(min=1e-30), floor)


def _r_hat(sums: _Sums, n: int, floor: Tensor) -> Tensor:
    """Split R-hat of the values drawn: halves of chains, n sweeps each, ``(rows, n_visible)``."""
    mean = (sums.drawn / n).transpose(0, 1).flatten(1, 2)
    square = (sums.square / n).transpose(0, 1).flatten(1, 2)
    within = ((square - mean.square()) * (n / (n - 1))).mean(1).maximum(floor)
    return ((n - 1) / n + mean.var(1) / within).sqrt()
