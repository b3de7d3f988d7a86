"""The digital state beside the voltages: reading it out, its energy and local fields, the descent from it.

A state ``x`` has its local fields, the change of energy with each bit; every flip keeps them up to date. Functions
are there for two layouts: ``..._matrix`` for two fully coupled layers (``rows``), restart by restart;
``..._listed`` for listed pairs and longer clauses (``lanes``), in all lanes side by side.
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
def add(lanes, rows, to, factor, row, at):
    """Add ``factor`` times a row of numbers, one a lane, to another row."""
    if lanes == U64(4):
        # Written out: the compiler makes no vector of four numbers that it must first prove to be apart.
        one, two, three = U64(1), U64(2), U64(3)
        first, second = rows[to] + factor * row[at], rows[to + one] + factor * row[at + one]
        third, fourth = rows[to + two] + factor * row[at + two], rows[to + three] + factor * row[at + three]
        rows[to], rows[to + one], rows[to + two], rows[to + three] = first, second, third, fourth
    else:
        for k in range(lanes):
            rows[to + k] += factor * row[at + k]


@inlined
def flip_listed(lanes, digital, x, field, true, i, change):
    """Change variable ``i`` by -1, 0 or 1 in each lane.

    ``x`` and ``field`` are flat, the lanes of a variable side by side. ``true`` counts the true literals of each
    longer clause.
    """
    start, neighbour, coupling, in_clause, clause_of, variables, polarity, weight = digital
    half, one, zero = F32(0.5), F32(1), F32(0)
    for at in range(start[i], start[i + 1]):
        add(lanes, field, U64(neighbour[at]) * lanes, coupling[at], change, U64(0))
    add(lanes, x, U64(i) * lanes, one, change, U64(0))
    for at in range(in_clause[i], in_clause[i + 1]):
        e, own = clause_of[at], zero
        row = U64(e) * lanes
        for j in range(variables.shape[1]):
            own += polarity[e, j] if variables[e, j] == i else zero
        for j in range(variables.shape[1]):
            sign, to = polarity[e, j], U64(variables[e, j]) * lanes
            if sign == zero or variables[e, j] == i:
                continue
            for k in range(lanes):
                # A literal decides its clause where no other one is true.
                holds, before = half + sign * (x[to + k] - half), true[row + k]
                was = weight[e] if before == holds else zero
                now = weight[e] if before + own * change[k] == holds else zero
                field[to + k] += sign * (was - now)
        add(lanes, true, row, own, change, U64(0))


@inlined
def local_fields_listed(lanes, digital, linear, x, field, true, energy):
    """Write the local fields and energies of all lanes from scratch."""
    start, neighbour, coupling, _, _, variables, polarity, weight = digital
    half, zero, row = F32(0.5), F32(0), U64(0)
    for k in range(lanes):
        energy[k] = 0.0
    for i in range(linear.size):
        for k in range(lanes):
            field[row + k] = linear[i]
        for at in range(start[i], start[i + 1]):
            add(lanes, field, row, coupling[at], x, U64(neighbour[at]) * lanes)
        for k in range(lanes):
            energy[k] += half * x[row + k] * (linear[i] + field[row + k])
        row += lanes
    row = U64(0)
    for e in range(weight.size):
        for k in range(lanes):
            true[row + k] = zero
        for j in range(variables.shape[1]):
            sign, at = polarity[e, j], U64(variables[e, j]) * lanes
            for k in range(lanes):
                true[row + k] += half * abs(sign) + sign * (x[at + k] - half)
        for k in range(lanes):
            energy[k] += weight[e] if true[row + k] == zero else zero
        for j in range(variables.shape[1]):
            sign, at = polarity[e, j], U64(variables[e, j]) * lanes
            for k in range(lanes):
                decides = true[row + k] == half + sign * (x[at + k] - half)
                field[at + k] -= sign * weight[e] if decides else zero
        row += lanes


@inlined
def read_out_listed(lanes, digital, voltage, x, field, true, energy, changed, change):
    """Bring all lanes up to the signs of their voltages; ``changed`` becomes 1 where any bit did."""
    one, zero, row = F32(1), F32(0), U64(0)
    for i in range(U64(x.size) // lanes):
        some = zero
        for k in range(lanes):
            change[k] = (one if voltage[row + k] > zero else zero) - x[row + k]
        for k in range(lanes):
            some += abs(change[k])
        if some > zero:
            for k in range(lanes):
                energy[k] += change[k] * field[row + k]
            for k in range(lanes):
                changed[k] = max(changed[k], abs(change[k]))
            flip_listed(lanes, digital, x, field, true, i, change)
        row += lanes


@inlined
def quench_listed(lanes, digital, x, field, true, energy, changed, change):
    """Flip single variables of the lanes that changed, as long as each flip lowers the energy."""
    one, two, zero = F32(1), F32(2), F32(0)
    for _ in range(MAX_SWEEPS):
        n_flips, row = zero, U64(0)
        for i in range(U64(x.size) // lanes):
            some = zero
            for k in range(lanes):
                flip = one - two * x[row + k]
                change[k] = flip * changed[k] if flip * field[row + k] < zero else zero
            for k in range(lanes):
                some += abs(change[k])
            if some > zero:
                n_flips += some
                for k in range(lanes):
                    energy[k] += change[k] * field[row + k]
                flip_listed(lanes, digital, x, field, true, i, change)
            row += lanes
        if n_flips == zero:
            break


@inlined
def keep_better_listed(lanes, energy, lowest, x, best, step, found_at, better, new):
    """Copy the states whose energies are lower than any before; note the step that met them first."""
    one, zero, some, row = F32(1), F32(0), F32(0), U64(0)
    for k in range(lanes):
        new[k], better[k] = zero, one if energy[k] < lowest[k] else zero
        some += better[k]
    if some == zero:
        return
    for _ in range(U64(x.size) // lanes):
        for k in range(lanes):
            new[k] += better[k] * abs(x[row + k] - best[row + k])
        for k in range(lanes):
            best[row + k] += better[k] * (x[row + k] - best[row + k])
        row += lanes
    for k in range(lanes):
        if better[k] > zero:
            lowest[k] = energy[k]
            if new[k] > zero or step == 0:
                found_at[k] = step
