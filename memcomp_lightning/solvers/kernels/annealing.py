"""Simulated annealing in which flips are events: fields are kept, and change by a row where a unit flips.

Field i is the energy of x_i = 1 less that of x_i = 0. Late in a schedule few units flip, so that a sweep costs
little more than reading its fields.
"""

import numpy as np
from numba import njit

from memcomp_lightning.solvers.kernels import random

F32 = np.float32

LANES = 16
"""Restarts that a sparse problem is annealed with side by side: a vector register of float32, or two."""

MOST_QUENCH_SWEEPS = 1000
"""Ends a quench that rounding errors would keep alternating between equal energies."""

FAST_MATH = {"reassoc", "contract", "nsz", "arcp"}


# ------------------------------------------------------------------------------------------------ two full layers


@njit(nogil=True, cache=True)
def anneal_layers(first_item, last_item, stop, problem, betas, quench, thresholds, seeds, best):
    """Anneal restarts ``first_item`` to ``last_item - 1`` of problems with two fully coupled layers.

    Args:
        first_item: Of ``n_problems * n_restarts``, problem after problem.
        last_item: One past the last.
        stop: Of one number; other than 0 ends the work: the state of the moment descends, and is the last.
        problem: ``of_first (n_problems, n_first, n_second)`` the couplings of each unit of the first layer,
            ``of_second`` its transpose, ``own (n_problems, n)`` the linear part.
        betas: Inverse temperatures, ``(n_problems, n_sweeps)``.
        quench: The first sweep after which a copy descends, and the sweeps from one to the next.
        thresholds: See ``random.thresholds``.
        seeds: ``(n_items,)``.
        best: Out, the best of the copies, ``(n_items, n)`` in {0, 1}; stays what it is where no time was left.
    """
    of_first, of_second, own = problem
    n_problems, n_first, n_second = of_first.shape
    n_restarts = seeds.size // n_problems
    x, kept = np.empty(n_first + n_second, np.float32), np.empty(n_first + n_second, np.float32)
    field, kept_field = np.empty_like(x), np.empty_like(x)
    flipped, state = np.empty(max(n_first, n_second) + 1, np.int64), np.empty(1, np.uint64)
    for item in range(first_item, last_item):
        if stop[0] and item > first_item:
            return
        p = item // n_restarts
        random.begin(state, seeds[item])
        by_first, by_second = of_first[p], of_second[p]
        for i in range(x.size):
            x[i] = F32(random.draw(state) >> np.uint64(63))
        field[:] = own[p]
        for i in range(n_first):
            if x[i] > F32(0):
                field[n_first:] += by_first[i]
        for i in range(n_second):
            if x[n_first + i] > F32(0):
                field[:n_first] += by_second[i]
        if (item - p * n_restarts) % 2 == 0:  # see random_states
            n = _settle(x[n_first:], field[n_first:], flipped)
            _add_rows(field[:n_first], by_second, flipped, n, x[n_first:])
        lowest, n_sweeps = F32(np.inf), betas.shape[1]
        for sweep in range(n_sweeps):
            beta = betas[p, sweep]
            at = random.below(state, random.N_THRESHOLDS)
            n = _draw(x[:n_first], field[:n_first], thresholds[at:], beta, flipped)
            _add_rows(field[n_first:], by_first, flipped, n, x[:n_first])
            at = random.below(state, random.N_THRESHOLDS)
            n = _draw(x[n_first:], field[n_first:], thresholds[at:], beta, flipped)
            _add_rows(field[:n_first], by_second, flipped, n, x[n_first:])
            is_last = sweep + 1 == n_sweeps or stop[0] != 0
            if is_last or (sweep >= quench[0] and (sweep - quench[0]) % quench[1] == 0):
                kept[:] = x
                kept_field[:] = field
                energy = _quench_layers(kept, kept_field, by_first, by_second, own[p], flipped)
                if energy < lowest:
                    lowest = energy
                    for i in range(x.size):
                        best[item, i] = kept[i] > F32(0)
            if is_last:
                break


@njit(nogil=True, cache=True, forceinline=True, fastmath=FAST_MATH)
def _draw(x, field, thresholds, beta, flipped):
    """Draw the units of a layer given the other; return how many flipped, and list them."""
    n = 0
    for i in range(x.size):
        new = F32(thresholds[i] < -beta * field[i])
        flipped[n] = i
        n += new != x[i]
        x[i] = new
    return n


@njit(nogil=True, cache=True, forceinline=True, fastmath=FAST_MATH)
def _settle(x, field, flipped):
    """Give each unit its best value; a tie keeps its value, so that equal energies do not alternate."""
    n = 0
    for i in range(x.size):
        new = x[i] if field[i] == F32(0) else F32(field[i] < F32(0))
        flipped[n] = i
        n += new != x[i]
        x[i] = new
    return n


@njit(nogil=True, cache=True, forceinline=True, fastmath=FAST_MATH)
def _add_rows(field, rows, flipped, n, x):
    """Bring the fields of a layer up to date, four units of the other at a time: that many rows a pass."""
    k = 0
    while k + 4 <= n:
        i, j, u, v = flipped[k], flipped[k + 1], flipped[k + 2], flipped[k + 3]
        a, b, c, d = rows[i], rows[j], rows[u], rows[v]
        s, t, y, z = _sign(x[i]), _sign(x[j]), _sign(x[u]), _sign(x[v])
        for m in range(field.size):
            field[m] += (s * a[m] + t * b[m]) + (y * c[m] + z * d[m])
        k += 4
    while k < n:
        i = flipped[k]
        a, s = rows[i], _sign(x[i])
        for m in range(field.size):
            field[m] += s * a[m]
        k += 1


@njit(nogil=True, cache=True, inline="always")
def _sign(x):
    """+1 of a unit that is on now, -1 of one that is off."""
    return x + x - F32(1)


@njit(nogil=True, cache=True, forceinline=True, fastmath=FAST_MATH)
def _quench_layers(x, field, by_first, by_second, own, flipped):
    """Descend, layer after layer; return the energy."""
    n_first = by_first.shape[0]
    for _ in range(MOST_QUENCH_SWEEPS):
        n = _settle(x[:n_first], field[:n_first], flipped)
        _add_rows(field[n_first:], by_first, flipped, n, x[:n_first])
        n = _settle(x[n_first:], field[n_first:], flipped)
        if n == 0:
            break
        _add_rows(field[:n_first], by_second, flipped, n, x[n_first:])
    energy = F32(0)
    for i in range(n_first):
        energy += x[i] * own[i]
    for i in range(n_first, x.size):
        energy += x[i] * field[i]
    return energy


# ---------------------------------------------------------------------------------------------------- listed pairs


@njit(nogil=True, cache=True)
def anneal_pairs(first_item, last_item, stop, problem, betas, quench, thresholds, seeds, best):
    """Anneal blocks of ``LANES`` restarts of problems with listed pairs, variable after variable.

    Args:
        first_item: Of ``n_problems * n_blocks``, problem after problem.
        last_item: One past the last.
        stop: Of one number; other than 0 ends the work: the state of the moment descends, and is the last.
        problem: ``begins (n + 1,)`` where the neighbours of each variable begin, ``neighbours (n_entries,)``,
            ``couplings (n_problems, n_entries)`` and ``own (n_problems, n)``, the linear part.
        betas: Inverse temperatures, ``(n_problems, n_sweeps)``.
        quench: The first sweep after which a copy descends, and the sweeps from one to the next.
        thresholds: See ``random.thresholds``.
        seeds: ``(n_items,)``.
        best: Out, the best of the copies, ``(n_items, n, LANES)`` in {0, 1}; stays what it is where no time
            was left.
    """
    begins, neighbours, couplings, own = problem
    n_problems, n = own.shape
    n_blocks = seeds.size // n_problems
    x, kept = np.empty((n, LANES), np.float32), np.empty((n, LANES), np.float32)
    field, kept_field = np.empty_like(x), np.empty_like(x)
    change, energy, lowest = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    state = np.empty(1, np.uint64)
    for item in range(first_item, last_item):
        if stop[0] and item > first_item:
            return
        p = item // n_blocks
        random.begin(state, seeds[item])
        pairs = (begins, neighbours, couplings[p])
        start_lanes(x, field, pairs, own[p], change, state)
        lowest[:] = np.inf
        n_sweeps = betas.shape[1]
        for sweep in range(n_sweeps):
            at = random.below(state, random.N_THRESHOLDS)
            sweep_lanes(x, field, pairs, thresholds, at, betas[p, sweep], change)
            is_last = sweep + 1 == n_sweeps or stop[0] != 0
            if is_last or (sweep >= quench[0] and (sweep - quench[0]) % quench[1] == 0):
                kept[:] = x
                kept_field[:] = field
                quench_lanes(kept, kept_field, pairs, own[p], change, energy)
                for lane in range(LANES):
                    if energy[lane] < lowest[lane]:
                        lowest[lane] = energy[lane]
                        for i in range(n):
                            best[item, i, lane] = kept[i, lane] > F32(0)
            if is_last:
                break


@njit(nogil=True, cache=True, forceinline=True)
def start_lanes(x, field, pairs, own, change, state):
    """Draw random states, with their fields."""
    for i in range(x.shape[0]):
        field[i] = own[i]
    for i in range(x.shape[0]):
        for lane in range(LANES):
            change[lane] = x[i, lane] = F32(random.draw(state) >> np.uint64(63))
        spread(field, pairs, i, change)


@njit(nogil=True, cache=True, forceinline=True, fastmath=FAST_MATH)
def sweep_lanes(x, field, pairs, thresholds, at, beta, change):
    """Draw each variable in turn given all others, in all lanes."""
    for i in range(x.shape[0]):
        pool = thresholds[(at + i * LANES) % random.N_THRESHOLDS :]
        own, here, n_flipped = x[i], field[i], F32(0)
        for lane in range(change.size):
            new = F32(pool[lane] < -beta * here[lane])
            change[lane] = new - own[lane]
            own[lane] = new
            n_flipped += change[lane] * change[lane]
        if n_flipped > F32(0):
            spread(field, pairs, i, change)


@njit(nogil=True, cache=True, forceinline=True, fastmath=FAST_MATH)
def spread(field, pairs, i, change):
    """Bring the fields of the neighbours of variable i up to date."""
    begins, neighbours, couplings = pairs
    for k in range(begins[i], begins[i + 1]):
        there, coupling = field[neighbours[k]], couplings[k]
        for lane in range(change.size):
            there[lane] += coupling * change[lane]


@njit(nogil=True, cache=True, forceinline=True, fastmath=FAST_MATH)
def quench_lanes(x, field, pairs, own, change, energy):
    """Descend variable by variable until no lane changes; write the energies."""
    for _ in range(MOST_QUENCH_SWEEPS):
        n_all = F32(0)
        for i in range(x.shape[0]):
            mine, here, n_flipped = x[i], field[i], F32(0)
            for lane in range(change.size):
                new = mine[lane] if here[lane] == F32(0) else F32(here[lane] < F32(0))
                change[lane] = new - mine[lane]
                mine[lane] = new
                n_flipped += change[lane] * change[lane]
            if n_flipped > F32(0):
                spread(field, pairs, i, change)
                n_all += n_flipped
        if n_all == F32(0):
            break
    energy[:] = F32(0)
    for i in range(x.shape[0]):
        for lane in range(change.size):
            energy[lane] += F32(0.5) * x[i, lane] * (field[i, lane] + own[i])
