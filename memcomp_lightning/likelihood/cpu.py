"""What the compiled kernel reads, and the call of it."""

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning.compiling import announce_compilation
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.likelihood.kernel import PACK, sum_over_second
from memcomp_lightning.likelihood.layers import Layers

announce_compilation()

Array = np.ndarray[Any, Any]

_LARGEST_LOG = 700.0
"""exp(700) is a float64 with room for a factor of 10^4."""


class Prepared(NamedTuple):
    """One replica as the kernel reads it.

    Attributes:
        small: Weight of the prefix and bias for each place in the packs, ``(n_places, n_first)``, ``(n_places,)``.
        large: The same of the units whose field may leave the range of exp.
        bias: Of the units of the prefix, ``(n_first,)``.
        second: What depends on u alone, see the kernel.
        closes: See the kernel.
    """

    small: tuple[Array, Array]
    large: tuple[Array, Array]
    bias: Array
    second: tuple[Array, Array, Array, Array]
    closes: Array


@np.errstate(all="ignore")
def prepare(one: Layers, n_second: int) -> Prepared:
    """Sort the units of the other layer into packs, tabulate what depends on u."""
    weight, bias, other = (x.numpy() for x in one[:3])
    n_first = weight.shape[1] - n_second
    # The largest values of A, B and A + B. Where exp(A) vanishes, exp(A + B) < exp(-40) does not matter to 1 + it.
    of_first = weight[:, :n_first].clip(0).sum(1) + other
    of_second = weight[:, n_first:].clip(0).sum(1)
    most = of_first + of_second
    small = np.maximum(most, np.maximum(of_first, of_second)) <= _LARGEST_LOG
    order, closes = _packs(np.logaddexp(0.0, most), np.flatnonzero(small))
    places = np.where(order[:, None] < 0, 0.0, weight[order])
    # An empty place is a unit that is never on.
    place_bias = np.where(order < 0, -np.inf, other[order])
    states = binary_states(n_second, like=one.weight).numpy()
    log_start = states @ bias[n_first:]
    exponent = np.floor(log_start / np.log(2.0))
    start = np.exp(log_start - exponent * np.log(2.0))
    table = np.exp(places[:, n_first:] @ states.T)
    large_table = weight[~small, n_first:] @ states.T
    return Prepared(
        (places[:, :n_first], place_bias),
        (weight[~small, :n_first], other[~small]),
        bias[:n_first],
        (table, large_table, start, exponent.astype(np.int64)),
        closes,
    )


@np.errstate(all="ignore")
def sum_compiled(prepared: Prepared, at: slice) -> Tensor:
    """Log of the summed weights of each prefix of a block."""
    shifts = np.arange(prepared.bias.size - 1, -1, -1)
    states = ((np.arange(at.start, at.stop)[:, None] >> shifts) & 1).astype(np.float64)
    small, large = (states @ weight.T + bias for weight, bias in (prepared.small, prepared.large))
    total, top = np.empty(len(states)), np.empty(len(states), np.int64)
    prefix = (np.exp(small, out=small), large)
    sum_over_second(prefix, prepared.second, prepared.closes, total, top)
    return torch.from_numpy(np.log(total) + top * np.log(2.0) + states @ prepared.bias)


def _packs(log_factor: Array, units: Array) -> tuple[Array, Array]:
    """Places of the units in packs, and the packs after which the product is brought back to [1, 2).

    Between two such packs the product of the largest factors stays below exp(700).
    """
    order: list[int] = []
    closes: list[bool] = []
    used = 0.0
    for unit in units.tolist():
        if used + log_factor[unit] > _LARGEST_LOG:
            order += [-1] * (-len(order) % PACK)
            closes[-1], used = True, 0.0
        if len(order) % PACK == 0:
            closes.append(False)
        order.append(unit)
        used += log_factor[unit]
    order += [-1] * (-len(order) % PACK)
    if closes:
        closes[-1] = True
    return np.array(order, dtype=np.int64), np.array(closes, dtype=np.bool_)
