"""The digital state beside the voltages: reading it out, its energy and local fields, the descent from it.

A state ``x`` has its local fields, the change of energy with each bit; every flip keeps them up to date. Functions
are there for two layouts: ``..._matrix`` for two fully coupled layers (``rows``), ``..._listed`` for listed pairs
and longer clauses (``lanes``), restart by restart.
"""

import numpy as np

from memcomp_lightning.solvers.dmm.kernels.common import F32, inlined

U64 = np.uint64

REFRESH = 64
"""Local fields are summed from scratch each so many readings, which bounds their rounding error."""

MAX_SWEEPS = 1000
"""Ends a quench that rounding errors would keep alternating between equal energies."""

MANY = 3
"""Where more than one bit in so many changes, writing all fields anew is faster than flip after flip."""


@inlined
def copy(source, target):
    """Copy numbers one by one: assigning a slice takes seconds to compile, for numba's error message alone."""
    for i in range(source.size):
        target[i] = source[i]


@inlined
def keep_if_new(x, best):
    """Copy a state; return whether it differs."""
    new = False
    for i in range(x.size):
        new |= best[i] != x[i]
        best[i] = x[i]
    return new


@inlined
def keep_better(energy, lowest, x, best, step, found_at):
    """Copy a state to ``best`` if its energy is lower; return the lowest energy, and the step that found it."""
    if energy < lowest:
        lowest = energy
        if keep_if_new(x, best) or step == 0:
            found_at = step
    return lowest, found_at


@inlined
def flip_matrix(n_first, n_second, coupling, transposed, x, field, i):
    """Flip one variable; return the change of energy."""
    change = F32(1) - F32(2) * x[i]
    gain = change * field[i]
    x[i] += change
    if i < n_first:
        row = i * n_second
        for j in range(n_second):
            field[n_first + j] += change * transposed[row + j]
    else:
        row = (i - n_first) * n_first
        for j in range(n_first):
            field[j] += change * coupling[row + j]
    return gain


@inlined
def local_fields_matrix(n_first, n_second, coupling, linear, x, field):
    """Write the local fields of a digital state from scratch; return its energy."""
    energy, row = 0.0, U64(0)
    for j in range(n_first + n_second):
        field[j] = linear[j]
        energy += linear[j] * x[j]
    for i in range(n_second):
        total, on = F32(0), x[n_first + i]
        for j in range(n_first):
            total += coupling[row + j] * x[j]
            field[j] += coupling[row + j] * on
        field[n_first + i] += total
        energy += total * on
        row += n_first
    return energy


@inlined
def quench_matrix(n_first, n_second, coupling, transposed, x, field, found):
    """Flip single variables, layer by layer, as long as each flip lowers the energy; return the change.

    ``found`` is scratch: the variables of a layer that want to flip. They are not coupled to each other.
    """
    total, one, two, n_resting = 0.0, F32(1), F32(2), 0
    for sweep in range(2 * MAX_SWEEPS):
        begin, end = (U64(0), n_first) if sweep % 2 == 0 else (n_first, n_first + n_second)
        n_eager = 0
        for i in range(begin, end):
            n_eager += 1 if (one - two * x[i]) * field[i] < 0 else 0
        n_resting = n_resting + 1 if n_eager == 0 else 0
        if n_resting == 2:
            break
        if n_eager > 0:
            # Without branches: the processor would guess every other one wrongly.
            k = U64(0)
            for i in range(begin, end):
                found[k] = i
                k += U64(1) if (one - two * x[i]) * field[i] < 0 else U64(0)
            for m in range(k):
                total += flip_matrix(n_first, n_second, coupling, transposed, x, field, found[m])
    return total


@inlined
def read_out_matrix(n_first, n_second, coupling, transposed, linear, voltage, x, field, energy, found):
    """Bring the digital state and its fields up to the voltages; return its energy and how many bits changed."""
    half, n, n_changed = F32(0.5), n_first + n_second, 0
    for i in range(n):
        n_changed += 1 if (voltage[i] > 0) != (x[i] > half) else 0
    if MANY * n_changed > n:
        for i in range(n):
            x[i] = F32(1) if voltage[i] > 0 else F32(0)
        energy = local_fields_matrix(n_first, n_second, coupling, linear, x, field)
    elif n_changed > 0:
        k = U64(0)
        for i in range(n):
            found[k] = i
            k += U64(1) if (voltage[i] > 0) != (x[i] > half) else U64(0)
        for m in range(k):
            energy += flip_matrix(n_first, n_second, coupling, transposed, x, field, found[m])
    return energy, n_changed


@inlined
def flip_listed(digital, x, field, true, i):
    """Flip variable ``i`` of one restart; return the change of energy.

    The digital states lie restart by restart, one number a variable: ``x`` and ``field`` of a restart stay close
    together. ``true`` counts the true literals of each longer clause.
    """
    start, neighbour, edge, coupling, in_clause, clause_of, variables, polarity, weight = digital
    half, one = F32(0.5), F32(1)
    change = one - F32(2) * x[i]
    gain = change * field[i]
    x[i] += change
    for at in range(start[i], start[i + 1]):
        field[neighbour[at]] += change * coupling[edge[at]]
    for at in range(in_clause[i], in_clause[i + 1]):
        clause_at = clause_of[at]
        before = true[clause_at]
        after = before
        for j in range(variables.shape[1]):
            if variables[clause_at, j] == i and polarity[clause_at, j] != 0:
                after += 1 if (polarity[clause_at, j] > 0) == (x[i] > half) else -1
        true[clause_at] = after
        for j in range(variables.shape[1]):
            other, sign = variables[clause_at, j], polarity[clause_at, j]
            if sign == 0 or other == i:
                continue
            holds = 1 if (sign > 0) == (x[other] > half) else 0
            # A literal decides its clause where no other one is true.
            was, now = before == holds, after == holds
            if was != now:
                field[other] += (-sign if now else sign) * weight[clause_at]
    return gain


@inlined
def local_fields_listed(digital, linear, pairs, x, field, true):
    """Write the local fields of one restart from scratch; return its energy."""
    coupling, variables, polarity, weight = digital[3], digital[6], digital[7], digital[8]
    half, energy = F32(0.5), 0.0
    copy(linear, field)
    for e in range(coupling.size):
        field[pairs[e, 0]] += coupling[e] * x[pairs[e, 1]]
        field[pairs[e, 1]] += coupling[e] * x[pairs[e, 0]]
    for i in range(linear.size):
        energy += half * x[i] * (linear[i] + field[i])
    for at in range(weight.size):
        count = 0
        for j in range(variables.shape[1]):
            sign = polarity[at, j]
            if sign != 0 and (sign > 0) == (x[variables[at, j]] > half):
                count += 1
        true[at] = count
        if count == 0:
            energy += weight[at]
        for j in range(variables.shape[1]):
            sign = polarity[at, j]
            if sign != 0:
                holds = 1 if (sign > 0) == (x[variables[at, j]] > half) else 0
                if count == holds:
                    field[variables[at, j]] -= sign * weight[at]
    return energy


@inlined
def quench_listed(digital, x, field, true):
    """Flip single variables of one restart as long as each flip lowers the energy; return the change."""
    one, two, total = F32(1), F32(2), 0.0
    for _ in range(MAX_SWEEPS):
        # A vector loop finds out whether anything moves; the sweep itself goes one by one.
        n_eager = 0
        for i in range(x.size):
            n_eager += 1 if (one - two * x[i]) * field[i] < 0 else 0
        if n_eager == 0:
            break
        for i in range(x.size):
            if (one - two * x[i]) * field[i] < 0:
                total += flip_listed(digital, x, field, true, i)
    return total


@inlined
def read_out_listed(digital, signs, x, field, true, found):
    """Bring one restart up to its voltages' signs; return the change of energy and how many bits changed."""
    change, n_found = 0.0, U64(0)
    for i in range(U64(x.size)):
        found[n_found] = i
        n_found += U64(1) if signs[i] != x[i] else U64(0)
    for m in range(n_found):
        change += flip_listed(digital, x, field, true, found[m])
    return change, n_found


@inlined
def transpose_signs(voltage, signs):
    """Write 1 for TRUE and 0 for FALSE, restart by restart, from voltages with the restarts last."""
    n, lanes = voltage.shape
    for first in range(0, n, 16):
        for k in range(lanes):
            for i in range(first, min(first + 16, n)):
                signs[k, i] = F32(1) if voltage[i, k] > 0 else F32(0)
