"""Gibbs chains with what is observed clamped, of many rows, at one temperature or at several."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.models.base import Block, EnergyModel


class Ladders(NamedTuple):
    """Several chains of each row, and of each chain a state for each temperature.

    Attributes:
        model: Without replica axes.
        blocks: Its classes of units; those of hidden ones alone come first.
        x: All units, ``(n_temperatures * n_rows * n_chains, n_units)``, the coldest states first.
        fixed: Which units are observed, of the same shape.
        n_chains: Of each row.
        betas: Inverse temperatures, from 1 down.
    """

    model: EnergyModel
    blocks: Sequence[Block]
    x: Tensor
    fixed: Tensor
    n_chains: int
    betas: tuple[float, ...]

    @classmethod
    def begun(
        cls,
        model: EnergyModel,
        v: Float[Tensor, "n n_visible"],
        observed: Bool[Tensor, "n n_visible"],
        n_chains: int,
        generator: Generator,
    ) -> "Ladders":
        """Chains at one temperature, in states as at infinite temperature."""
        v, observed = (x.repeat_interleave(n_chains, dim=0) for x in (v, observed))
        alone = model.visible.sample(torch.zeros_like(v), generator=generator)
        h = model.hidden.sample(v.new_zeros(len(v), model.n_hidden), generator=generator)
        x = torch.cat((torch.where(observed, v, alone), h), dim=-1)
        fixed = torch.cat((observed, torch.zeros_like(h, dtype=torch.bool)), dim=-1)
        # The hidden units follow the start of the visible ones, not the other way round.
        blocks = sorted(model.blocks(), key=lambda block: bool((block.units < model.n_visible).any()))
        return cls(model, blocks, x, fixed, n_chains, (1.0,))

    @property
    def n(self) -> int:
        """Number of chains of all rows."""
        return len(self.x) // len(self.betas)

    def visible(self) -> Float[Tensor, "n n_chains n_visible"]:
        """Visible units of the coldest states."""
        return self.x[: self.n, : self.model.n_visible].reshape(-1, self.n_chains, self.model.n_visible)

    def of(self, rows: Bool[Tensor, " n"]) -> "Ladders":
        """Those of some rows."""
        every = rows.repeat_interleave(self.n_chains).repeat(len(self.betas))
        return self._replace(x=self.x[every], fixed=self.fixed[every])

    def heated(self, n_temperatures: int) -> "Ladders":
        """The same states at each of some temperatures, evenly spaced in beta down to infinite temperature."""
        betas = tuple(1 - step / (n_temperatures - 1) for step in range(n_temperatures))
        return self._replace(x=self.x.repeat(len(betas), 1), fixed=self.fixed.repeat(len(betas), 1), betas=betas)

    def sweep(self, generator: Generator, *, beta: float = 1.0, first: int = 0) -> Float[Tensor, "m n_visible"]:
        """Draw all that is not observed, in place, and exchange states of neighbouring temperatures.

        Args:
            generator: Random stream.
            beta: Multiplies the inverse temperatures.
            first: The coldest temperature that exchanges its state with the next one, 0 or 1.

        Returns:
            The means from which the visible units of the coldest states were drawn.
        """
        x, n, n_cold = self.x, self.model.n_visible, self.n
        means = x.new_zeros(n_cold, n)
        factor = beta * x.new_tensor(self.betas).repeat_interleave(n_cold).unsqueeze(-1)
        for block in self.blocks:
            at, field = block.units, factor * block.field(x)
            seen, new = at < n, block.kind.sample(field, generator=generator)
            if bool(seen.any()):
                new = torch.where(self.fixed[:, at], x[:, at], new)
                means[:, at[seen]] = block.kind.mean(field[:n_cold])[:, seen]
            x[:, at] = new
        if len(self.betas) > 1:
            self._exchange(first, generator)
        return means

    def _exchange(self, first: int, generator: Generator) -> None:
        """Swap states of every second pair of neighbours with probability min(1, exp(gap of beta * gap of E))."""
        n, last = self.model.n_visible, len(self.betas) - 1
        cold, hot = slice(first, last, 2), slice(first + 1, None, 2)
        energy = self.model.tempered_energy(self.x[:, :n], self.x[:, n:]).view(len(self.betas), -1)
        beta, x = self.x.new_tensor(self.betas).unsqueeze(-1), self.x.view(len(self.betas), -1, self.x.shape[-1])
        log_ratio = (beta[cold] - beta[hot]) * (energy[cold] - energy[hot])
        swaps = (rng.uniform(log_ratio.shape, generator=generator, like=log_ratio) < log_ratio.exp()).unsqueeze(-1)
        x[cold], x[hot] = torch.where(swaps, x[hot], x[cold]), torch.where(swaps, x[cold], x[hot])
