r"""What broken rows ``lower <= a . x <= upper`` of whole numbers cost, as a QUBO.

A row whose sum S may take one value b costs ``(S - b)^2``. One whose sum may take more, ``lower`` to ``upper``,
costs ``(S - lower - t) (S - lower - t - 1) / 2``: 0 at two values side by side, 1 next to them, more further away.
Auxiliary variables choose t, from 0 to ``upper - lower - 1``. A clause is a row: at least one literal is true.
With two literals it needs no auxiliary variable, with three it needs one, with k it needs about log2 k.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.arrays import Array, alike, cast, namespace, to_numpy
from memcomp_lightning.problems.qubo import Qubo, wide

Integers = NDArray[np.int64]


class Rows(NamedTuple):
    """Rows of as many variables each, and as many values that their sums may take.

    Attributes:
        variables: ``(n_rows, length)``, those of a row differ.
        coefficients: ``(n_rows, length)``.
        lower: Smallest allowed sum, ``(n_rows,)``.
        width: Largest allowed sum less the smallest, >= 0.
        weight: What a row costs that is broken by one, ``(*problems, n_rows)``.
    """

    variables: Integers
    coefficients: Integers
    lower: Integers
    width: int
    weight: Array


def plus_rows(qubo: Qubo, blocks: Iterable[Rows]) -> Qubo:
    """Add what broken rows cost; auxiliary variables, whose best values make it so, come last."""
    xp, pairs, own = namespace(qubo.linear), to_numpy(qubo.graph.edges()), np.arange(qubo.n)
    first, second = [pairs[:, 0], own], [pairs[:, 1], own]
    values: list[Array] = [qubo.coupling.reshape(*qubo.problems, -1), qubo.linear]
    n, offset = qubo.n, qubo.offset
    for variables, coefficients, lower, width, weight in blocks:
        n_rows, bits = len(lower), _bits(width - 1)
        auxiliary = n + np.arange(n_rows * len(bits)).reshape(n_rows, -1)
        n += auxiliary.size
        x = np.concatenate((variables, auxiliary), axis=1)
        a = np.concatenate((coefficients, -np.broadcast_to(bits, auxiliary.shape)), axis=1)
        # (S - lower)^2, or (S - lower) (S - lower - 1) / 2, with t in the sum S.
        twice, roots = (1, 2 * lower + 1) if width else (2, 2 * lower)
        i, j = np.triu_indices(x.shape[1], 1)
        first += [x[:, i].ravel(), x.ravel()]
        second += [x[:, j].ravel(), x.ravel()]
        for factor in (twice * a[:, i] * a[:, j], twice * a * (a - roots[:, None]) // 2):
            of_entries = weight[..., None] * cast(alike(factor, weight), weight.dtype)
            values.append(of_entries.reshape(*qubo.problems, -1))
        constant = twice * lower * (roots - lower) // 2
        offset = offset + wide(weight * cast(alike(constant, weight), weight.dtype)).sum(-1)
    rows, columns = (alike(np.concatenate(part), qubo.linear) for part in (first, second))
    return Qubo.from_coo(n, rows, columns, xp.concat(values, axis=-1), offset)


def _bits(most: int) -> Integers:
    """Numbers of which some add up to each integer from 0 to ``most``, and none to more."""
    if most <= 0:
        return np.zeros(0, np.int64)
    powers = 2 ** np.arange(most.bit_length() - 1)
    return np.append(powers, most - powers.sum())
