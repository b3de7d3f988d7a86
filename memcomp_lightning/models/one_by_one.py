"""Gibbs sweeps over bits and spins that are all coupled to each other: one after the other, in few operations."""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.ambient import in_own_dtypes
from memcomp_lightning.models.base import Block
from memcomp_lightning.models.units import Bernoulli, Spin


class OneByOne(NamedTuple):
    r"""Classes of one bit or spin each, drawn in order.

    A unit is ``low + width * bit``. With the field f given all others, its bit is 1 where
    :math:`\beta f > \mathrm{logit}(u) / width` for a uniform u, the one that the unit's own ``sample`` would draw.
    All that does not depend on the bits of the others is computed at once; a unit then takes one product of its
    couplings with these bits, and one comparison.

    Attributes:
        units: Their indices in the order of the sweep, ``(n,)``.
        inner: Couplings of each to the bits of all, replicas on one axis: n of ``(n_replicas, 1, n)``.
        outer: Couplings to all other units, zero to their own, ``(*replicas, n, n_units)``.
        bias: With what their lower values add, ``(*replicas, n)``.
        low: ``(n,)``.
        width: ``(n,)``.
    """

    units: Tensor
    inner: tuple[Tensor, ...]
    outer: Tensor
    bias: Tensor
    low: Tensor
    width: Tensor

    @torch.no_grad()
    @in_own_dtypes
    def draw(self, x: Tensor, beta: float | Tensor, base: Tensor | None, *, generator: Generator) -> None:
        """Draw the units in ``x``, see ``Block.draw``."""
        n_chains, replicas, n = x.shape[-2], x.shape[:-2], len(self.units)
        u = rng.uniform((n, *replicas, n_chains), generator=generator, like=x)
        threshold = (torch.logit(u).movedim(0, -1) / self.width).mT
        if isinstance(beta, Tensor):
            beta = beta.expand(*replicas, n_chains, 1).mT
        if base is not None:
            threshold = threshold - (1 - beta) * base[..., self.units].unsqueeze(-1)
        # Divided by zero, a threshold is infinite, with its sign.
        threshold = threshold / beta - (self.outer @ x.mT + self.bias.unsqueeze(-1))
        bits = ((x[..., self.units] - self.low) / self.width).mT.reshape(-1, n, n_chains).contiguous()
        threshold = threshold.reshape(-1, n, n_chains)
        field = x.new_empty(len(bits), 1, n_chains)
        for row, least, bit in zip(self.inner, threshold.split(1, -2), bits.split(1, -2), strict=True):
            torch.bmm(row, bits, out=field)
            torch.gt(field, least, out=bit)
        x[..., self.units] = self.low + self.width * bits.reshape(*replicas, n, n_chains).mT


@torch.no_grad()
def in_runs(blocks: Sequence[Block]) -> list[Block | OneByOne]:
    """The same classes in the same order, those of one bit or spin each that follow each other as one run."""
    found: list[Block | OneByOne] = []
    for alone, group in groupby(blocks, _alone):
        some = list(group)
        found += [_run(some)] if alone and len(some) > 1 else some
    return found


def _alone(block: Block) -> bool:
    return block.kind.n == 1 and block.to_all and type(block.kind) in (Bernoulli, Spin)


def _run(blocks: Sequence[Block]) -> OneByOne:
    units = torch.cat([block.units for block in blocks])
    couplings = torch.cat([block.couplings for block in blocks], dim=-2)
    low, width = (_column(values, couplings) for values in zip(*map(_low_and_width, blocks), strict=True))
    inner, outer = couplings[..., units], couplings.index_fill(-1, units, 0.0)
    bias = torch.cat([block.bias for block in blocks], dim=-1) + (inner * low).sum(-1)
    rows = (inner * width).reshape(-1, len(units), len(units)).split(1, -2)
    return OneByOne(units, rows, outer, bias, low, width)


def _low_and_width(block: Block) -> tuple[float, float]:
    return (-1.0, 2.0) if isinstance(block.kind, Spin) else (0.0, 1.0)


def _column(values: Iterable[float], like: Tensor) -> Tensor:
    # Filled on the device: a copy of values from the host would wait for it.
    return torch.cat([like.new_full((len(list(equal)),), value) for value, equal in groupby(values)])
