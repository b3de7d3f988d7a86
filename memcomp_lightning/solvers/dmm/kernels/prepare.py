"""Compiled twin of ``ClauseField.build`` and ``BondField.build`` for two fully coupled layers.

The tensor operations of ``build`` would take as long as solving a 32x32 problem; compiled, the same arithmetic
takes next to nothing. ``scaling.py`` and the fields explain the quantities.
"""

import math

import numpy as np
from numba import njit

from memcomp_lightning.solvers.dmm.kernels.common import BOND, F32
from memcomp_lightning.solvers.dmm.kernels.digital import copy
from memcomp_lightning.solvers.dmm.scaling import POWER_ITERATIONS, SIZE_EXPONENT, SMALLEST_RATIO


@njit(nogil=True, cache=True, error_model="numpy")
def prepare(kind, width, height, coupling, linear, weight, unit, scalars, digital, transposed, fields):
    """Scale problems into the machine's units and into those of the digital state.

    Args:
        kind: ``BOND`` or not.
        width: Of the first layer with its padding, >= n_first.
        height: Of the second layer with its padding, >= n_second.
        coupling: ``(n_problems, n_second, n_first)`` float64.
        linear: ``(n_problems, n)`` float64.
        weight: Out, ``(n_problems, n_second * width)``: bonds, or clause weights with the sign of the first
            polarity; this and all that follow hold 0 where there is padding.
        unit: Out, ``(n_problems, width + height)``: unit clauses or fields.
        scalars: Out, ``(n_problems, 3)``: stability, scale of the pull, effective degree.
        digital: Out, coupling over a power of two, ``(n_problems, height * width)``.
        transposed: Out, its transpose.
        fields: Out, linear over the same.
    """
    n_problems, n_second, n_first = coupling.shape
    n = n_first + n_second
    scaled, own, sums = np.empty((n_second, n_first)), np.empty(n), np.empty(n)
    for p in range(n_problems):
        largest = max(_largest(coupling[p].ravel()), _largest(linear[p]))
        power_of_two = 2.0 ** math.frexp(max(largest, 1e-300))[1]
        for i in range(n_second):
            for j in range(n_first):
                digital[p, i * width + j] = coupling[p, i, j] / power_of_two
                transposed[p, j * height + i] = coupling[p, i, j] / power_of_two
        for i in range(n):
            at = i if i < n_first else width + i - n_first
            fields[p, at] = linear[p, i] / power_of_two
        if kind == BOND:
            _add_both(coupling[p], sums)
            for i in range(n):
                own[i] = -2.0 * linear[p, i] - sums[i]
        else:
            _unit_clauses(coupling[p], linear[p], own)
            largest = max(_largest(coupling[p].ravel()), _largest(own))
        largest = largest if largest > 0 else 1.0
        copy(coupling[p].ravel(), scaled.ravel())
        _divide(scaled, own, largest)
        _add_both(scaled * scaled, sums)
        norm, n_coupled = _or_one(math.sqrt(_mean_of_used(sums))), max((sums > 0).sum(), 1)
        scalars[p, 2] = _effective_degree(scaled, sums)
        _divide(scaled, own, norm)
        scalars[p, 0] = (n_coupled / 200) ** -SIZE_EXPONENT * math.sqrt(n_coupled / n)
        scalars[p, 1] = 1.0
        if kind == BOND:
            collective = _collective_mode(scaled)
            for i in range(n):
                own[i] *= collective
            for i in range(n_second):
                for j in range(n_first):
                    scaled[i, j] *= -collective
        _add_both(np.abs(scaled), sums)
        if kind == BOND:
            scalars[p, 0], scalars[p, 1] = 1.0, _or_one(_mean_of_used(sums))
        for i in range(n):
            limit = max(2.0 * sums[i], 1.0)
            at = i if i < n_first else width + i - n_first
            unit[p, at] = min(limit, max(-limit, own[i]))
        for i in range(n_second):
            for j in range(n_first):
                w = scaled[i, j]
                # The first literal has the polarity of the second, or the other one where w < 0.
                weight[p, i * width + j] = w if kind == BOND else -_way(i, j, n_second, n_first) * w


@njit(nogil=True, cache=True, forceinline=True)
def _way(i, j, n_second, n_first):
    """``Bipartite.alternating``."""
    return 1.0 if (2 * i >= n_second) == (2 * j >= n_first) else -1.0


@njit(nogil=True, cache=True, forceinline=True)
def _unit_clauses(coupling, linear, unit):
    """The unit clauses of ``maxsat.from_qubo``."""
    n_second, n_first = coupling.shape
    for i in range(unit.size):
        unit[i] = -linear[i]
    for i in range(n_second):
        for j in range(n_first):
            size, second = abs(coupling[i, j]), -_way(i, j, n_second, n_first)
            first = -second if coupling[i, j] < 0 else second
            unit[j] -= size * first * (1 + second) / 2
            unit[n_first + i] -= size * second * (1 + first) / 2


@njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def _divide(matrix, values, divisor):
    for i in range(values.size):
        values[i] /= divisor
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            matrix[i, j] /= divisor


@njit(nogil=True, cache=True, forceinline=True)
def _largest(values):
    largest = 0.0
    for value in values:
        largest = max(largest, abs(value))
    return largest


@njit(nogil=True, cache=True, forceinline=True)
def _add_both(matrix, sums):
    """Column sums, then row sums."""
    n_second, n_first = matrix.shape
    sums[:] = 0.0
    for i in range(n_second):
        for j in range(n_first):
            sums[j] += matrix[i, j]
            sums[n_first + i] += matrix[i, j]


@njit(nogil=True, cache=True, forceinline=True)
def _mean_of_used(sums):
    """Mean over the variables that are coupled."""
    total, n_used = 0.0, 0
    for value in sums:
        total += value
        n_used += 1 if value > 0 else 0
    return total / max(n_used, 1)


@njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def _effective_degree(matrix, power):
    """``scaling.effective_degree``."""
    size, total, n_used = np.empty_like(power), 0.0, 0
    _add_both(np.abs(matrix), size)
    for i in range(power.size):
        if power[i] > 0:
            total += size[i] * size[i] / power[i]
            n_used += 1
    return max(total / max(n_used, 1), 1.0)


@njit(nogil=True, cache=True, forceinline=True)
def _or_one(scale):
    return scale if scale > SMALLEST_RATIO else 1.0


@njit(nogil=True, cache=True, error_model="numpy", forceinline=True)
def _collective_mode(coupling):
    """``scaling.collective_mode``."""
    n_second, n_first = coupling.shape
    x, y = np.empty(n_first + n_second), np.empty(n_first + n_second)
    for i in range(x.size):
        x[i] = 1.0 + 0.5 * math.sin(F32(i) * F32(i))
    for _ in range(POWER_ITERATIONS + 1):
        before = 0.0
        for value in x:
            before += value * value
        y[:] = 0.0
        for i in range(n_second):
            for j in range(n_first):
                y[j] += coupling[i, j] * x[n_first + i]
                y[n_first + i] += coupling[i, j] * x[j]
        after = 0.0
        for value in y:
            after += value * value
        x, y = y, x
    return min(1.0, 2.0 / max(math.sqrt(after) / max(math.sqrt(before), SMALLEST_RATIO), SMALLEST_RATIO))
