"""Compiled kernel for listed pairs and longer clauses: vectors run along the restarts.

One call integrates ``LANES`` restarts side by side, so that a sparse problem needs no gathers: every number of
a variable or a clause is a vector over the restarts. Time and memory are linear in the number of pairs. All
arrays are float32 with the lanes last; each lane has a step size of its own. The equations are those of
``ClauseField`` and ``BondField``, the scheme is ``Splitting``.

The inner loops are split so that each writes one array: the compiler then needs few overlap checks to turn
them into vector code.
"""

import math

import numpy as np
from numba import njit

from memcomp_lightning.dmm.kernels.common import BOND, F32, FAST_MATH, LANES, MAX_SWEEPS, REFRESH, uniform


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def clause_pass(pairs, weight, polarity, memory, voltage, drive, push, c, dt):
    """Advance the memories of all pairs by ``dt`` at the present voltages, then add the pairs' drive.

    ``memory`` holds x_s + epsilon and x_l - 1 of each pair, ``(n_pairs, 2 LANES)``; ``push`` is scratch.
    """
    zero, half, one = F32(0), F32(0.5), F32(1)
    alpha, beta, gamma, delta, epsilon, zeta, cap = c[0], c[1], c[2], c[3], c[4], c[5], c[6] - one
    top, stiff = one + epsilon, one + zeta
    for e in range(weight.size):
        w = weight[e]
        first, second = polarity[e, 0], polarity[e, 1]
        a, b, m = voltage[pairs[e, 0]], voltage[pairs[e, 1]], memory[e]
        for k in range(LANES):
            false_first, false_second = half - half * first * a[k], half - half * second * b[k]
            unsatisfied = min(false_first, false_second)
            s = min(top, max(epsilon, m[k] * (one + dt[k] * beta * (unsatisfied - gamma))))
            x = m[LANES + k]
            excess = dt[k] * alpha * (unsatisfied - delta)
            x = min(cap, x + excess * (one if excess > zero else x))
            m[k] = s
            m[LANES + k] = x
            agile = w * (s - epsilon)
            gradient = agile + agile * x
            rigidity = (w - agile) * unsatisfied * (stiff + zeta * x)
            at_first = rigidity if false_first <= false_second else zero
            push[k] = first * (gradient * false_second + at_first)
            push[LANES + k] = second * (gradient * false_first + (rigidity - at_first))
        add(drive[pairs[e, 0]], push[:LANES])
        add(drive[pairs[e, 1]], push[LANES:])


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def add(total, part):
    """``total += part`` over the lanes."""
    for k in range(LANES):
        total[k] += part[k]


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def longer_pass(variables, polarity, weight, memory, voltage, drive, falsehood, c, dt):
    """The same for clauses of three literals and more, padded with polarity 0; ``falsehood`` is scratch."""
    zero, half, one = F32(0), F32(0.5), F32(1)
    alpha, beta, gamma, delta, epsilon, zeta, cap = c[0], c[1], c[2], c[3], c[4], c[5], c[6] - one
    for e in range(weight.size):
        w, m = weight[e], memory[e]
        length = 0
        while length < variables.shape[1] and polarity[e, length] != 0:
            length += 1
        for i in range(length):
            v, q, f = voltage[variables[e, i]], polarity[e, i], falsehood[i]
            for k in range(LANES):
                f[k] = half - half * q * v[k]
        for k in range(LANES):
            smallest, next_smallest, at = F32(2), F32(2), 0
            for i in range(length):
                f = falsehood[i, k]
                if f < smallest:
                    smallest, next_smallest, at = f, smallest, i
                elif f < next_smallest:
                    next_smallest = f
            s = min(one + epsilon, max(epsilon, m[k] * (one + dt[k] * beta * (smallest - gamma))))
            x = m[LANES + k]
            excess = dt[k] * alpha * (smallest - delta)
            x = min(cap, x + excess * (one if excess > zero else x))
            m[k] = s
            m[LANES + k] = x
            agile = w * (s - epsilon)
            gradient = agile + agile * x
            rigidity = (w - agile) * smallest * (one + zeta + zeta * x)
            for i in range(length):
                push = gradient * next_smallest + rigidity if i == at else gradient * smallest
                drive[variables[e, i], k] += polarity[e, i] * push


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def clause_units(unit, long, voltage, drive, c, dt):
    """Advance the memories of the unit clauses and add their pull."""
    half, one = F32(0.5), F32(1)
    alpha, delta, cap, strength = c[0], c[3], c[6] - one, c[7]
    for i in range(unit.size):
        u = unit[i]
        sign = half if u > 0 else (-half if u < 0 else F32(0))
        v, d, m = voltage[i], drive[i], long[i]
        for k in range(LANES):
            excess = dt[k] * alpha * (half - sign * v[k] - delta)
            m[k] = min(cap, m[k] + excess * (one if excess > 0 else m[k]))
        for k in range(LANES):
            d[k] += strength * u * (one + m[k])


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def bond_pass(pairs, bond, memory, voltage, rate, push, c, dt):
    """Advance the memories of all bonds by ``dt`` at the present voltages, then add their drive and pull.

    ``memory`` holds X and Y - 1 of each bond, ``rate`` the drive and the pull of each spin, 2 LANES each.
    """
    zero, one = F32(0), F32(1)
    gamma, kappa, delta, zeta, low, cap = c[2], c[3], c[4], c[5], c[6], c[7] - one
    lift = gamma - one
    for e in range(bond.size):
        w = bond[e]
        size = abs(w)
        satisfied = gamma * kappa * (one if w > zero else (-one if w < zero else zero))
        a, b, m = voltage[pairs[e, 0]], voltage[pairs[e, 1]], memory[e]
        for k in range(LANES):
            x, y = m[k], m[LANES + k]
            m[LANES + k] = min(cap, max(zero, y + dt[k] * (delta * x - zeta)))
            x = min(one, max(low, x + dt[k] * (lift - y + satisfied * (a[k] * b[k]))))
            m[k] = x
            push[k] = size * x
        strain(rate[pairs[e, 0]], b, push, w)
        strain(rate[pairs[e, 1]], a, push, w)


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def strain(rate, other, strength, w):
    """Add a bond's drive and pull to one of its spins."""
    for k in range(LANES):
        rate[k] += w * other[k]
        rate[LANES + k] += strength[k]


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def bond_fields(field, short, long, voltage, rate, c, dt):
    """Advance the memories of the fields, then turn drive and pull into the rate of the voltages."""
    zero, one = F32(0), F32(1)
    alpha, gamma, kappa, delta, zeta, low, cap = c[0], c[2], c[3], c[4], c[5], c[6], c[7] - one
    pull_rate = F32(2) * c[1] / c[9]
    for i in range(field.size):
        h = field[i]
        size = abs(h)
        sign = one if h > zero else (-one if h < zero else zero)
        v, r, s, m = voltage[i], rate[i], short[i], long[i]
        for k in range(LANES):
            x, y = s[k], m[k]
            m[k] = min(cap, max(zero, y + dt[k] * (delta * x - zeta)))
            s[k] = min(one, max(low, x + dt[k] * (gamma * (one + kappa * sign * v[k]) - one - y)))
        for k in range(LANES):
            r[k] = alpha * (r[k] + h) - pull_rate * (r[LANES + k] + size * s[k]) * v[k]


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def flip(digital, x, field, true, i, k):
    """Flip variable ``i`` of lane ``k``; return the change of energy.

    ``true`` counts the true literals of each longer clause.
    """
    start, neighbour, edge, coupling, in_clause, clause_of, variables, polarity, weight = digital
    half, one = F32(0.5), F32(1)
    change = one - F32(2) * x[i, k]
    gain = change * field[i, k]
    x[i, k] += change
    for at in range(start[i], start[i + 1]):
        field[neighbour[at], k] += change * coupling[edge[at]]
    for at in range(in_clause[i], in_clause[i + 1]):
        clause = clause_of[at]
        before = true[clause, k]
        after = before
        for j in range(variables.shape[1]):
            if variables[clause, j] == i and polarity[clause, j] != 0:
                after += 1 if (polarity[clause, j] > 0) == (x[i, k] > half) else -1
        true[clause, k] = after
        for j in range(variables.shape[1]):
            other, sign = variables[clause, j], polarity[clause, j]
            if sign == 0 or other == i:
                continue
            holds = 1 if (sign > 0) == (x[other, k] > half) else 0
            # A literal decides its clause where no other one is true.
            was, now = before == holds, after == holds
            if was != now:
                field[other, k] += (-sign if now else sign) * weight[clause]
    return gain


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def local_fields(digital, linear, pairs, x, field, true, k):
    """Write the local fields of lane ``k`` from scratch; return its energy."""
    coupling, variables, polarity, weight = digital[3], digital[6], digital[7], digital[8]
    half = F32(0.5)
    energy = 0.0
    for i in range(linear.size):
        field[i, k] = linear[i]
        energy += linear[i] * x[i, k]
    for e in range(coupling.size):
        a, b = pairs[e, 0], pairs[e, 1]
        field[a, k] += coupling[e] * x[b, k]
        field[b, k] += coupling[e] * x[a, k]
        energy += coupling[e] * x[a, k] * x[b, k]
    for clause in range(weight.size):
        count = 0
        for j in range(variables.shape[1]):
            sign = polarity[clause, j]
            if sign != 0 and (sign > 0) == (x[variables[clause, j], k] > half):
                count += 1
        true[clause, k] = count
        if count == 0:
            energy += weight[clause]
        for j in range(variables.shape[1]):
            sign = polarity[clause, j]
            if sign != 0:
                holds = 1 if (sign > 0) == (x[variables[clause, j], k] > half) else 0
                if count == holds:
                    field[variables[clause, j], k] -= sign * weight[clause]
    return energy


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def quench(digital, x, field, true):
    """Flip single variables of one lane as long as each flip lowers the energy; return the change."""
    total = 0.0
    for _ in range(MAX_SWEEPS):
        moving = False
        for i in range(x.shape[0]):
            if (field[i, 0] < 0) if x[i, 0] < F32(0.5) else (field[i, 0] > 0):
                total += flip(digital, x, field, true, i, 0)
                moving = True
        if not moving:
            break
    return total


@njit(nogil=True, cache=True)
def integrate_all(begin, end, problem, control, start, steps, best, found_at, times, states):
    """Integrate the blocks of restarts numbered ``begin`` to ``end - 1``, problem by problem.

    Args:
        begin: First block.
        end: Behind the last block.
        problem: (kind, constants, pairs, weight, polarity, unit, longer, digital, linear); constants, weight,
            unit and linear have an axis of problems, so have the weights in longer and digital.
        control: (max_change, dt_min, dt_max, noise).
        start: (voltage, long, unit_long, longer_long), each ``(n_problems, n_blocks, ..., LANES)``, and the seed.
        steps: (n_steps, quench_every, record_every), 0 for never.
        best: Out, ``(n_problems, n_blocks, LANES, n)``.
        found_at: Out, ``(n_problems, n_blocks, LANES)``.
        times: Out, ``(n_problems, n_blocks, LANES, n_records)``.
        states: Out, ``(n_problems, n_blocks, LANES, n_records, n)``.
    """
    kind, constants, pairs, weight, polarity, unit, longer, digital, linear = problem
    variables, longer_polarity, longer_weight = longer
    offsets, neighbour, edge, coupling, in_clause, clause_of, clause_weight = digital
    voltage, long, unit_long, longer_long, seed = start
    n_blocks = voltage.shape[1]
    for item in range(begin, end):
        p, b = item // n_blocks, item % n_blocks
        found_at[p, b] = integrate(
            (kind, pairs, weight[p], polarity[p], unit[p], variables, longer_polarity, longer_weight[p]),
            (offsets, neighbour, edge, coupling[p], in_clause, clause_of, variables, longer_polarity, clause_weight[p]),
            linear[p],
            constants[p],
            control,
            (voltage[p, b], long[p, b], unit_long[p, b], longer_long[p, b], seed[p, b]),
            steps,
            best[p, b],
            times[p, b],
            states[p, b],
        )


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def integrate(problem, digital, linear, c, control, start, steps, best, times, states):
    """Integrate LANES restarts; return the step at which each one's ``best`` was met, 0 for the initial state.

    Args:
        problem: (kind, pairs, weight or bond, polarity, unit or field, variables, polarity and weight of the
            longer clauses).
        digital: What ``flip`` needs.
        linear: ``(n,)``, of the energy.
        c: Constants of the field, in the order of ``cpu._constants``.
        control: (max_change, dt_min, dt_max, noise).
        start: (voltage, long-term memories less 1 of pairs, of units and of longer clauses), each with the lanes
            last, initial values in and final values out; and the seeds of the noise.
        steps: (n_steps, quench_every, record_every).
        best: ``(LANES, n)``, out: the assignments of lowest energy.
        times: ``(LANES, n_records)``, out.
        states: ``(LANES, n_records, n)``, out.
    """
    kind, pairs, weight, polarity, unit, longer_variables, longer_polarity, longer_weight = problem
    voltage, long, unit_long, longer_long, seeds = start
    n_steps, quench_every, every = steps
    half, one = F32(0.5), F32(1)
    n, n_pairs, n_longer = unit.size, weight.size, longer_weight.size
    rate, push = np.zeros((n, 2 * LANES), F32), np.empty(2 * LANES, F32)
    memory, longer_memory = np.empty((n_pairs, 2 * LANES), F32), np.empty((n_longer, 2 * LANES), F32)
    unit_short = np.full((n, LANES), c[8], F32)
    falsehood = np.empty((longer_variables.shape[1], LANES), F32)
    for e in range(n_pairs):
        for k in range(LANES):
            false_first = half - half * polarity[e, 0] * voltage[pairs[e, 0], k]
            false_second = half - half * polarity[e, 1] * voltage[pairs[e, 1], k]
            memory[e, k] = c[8] if kind == BOND else c[4] + min(false_first, false_second)
            memory[e, LANES + k] = long[e, k]
    for e in range(n_longer):
        for k in range(LANES):
            smallest = one
            for j in range(longer_variables.shape[1]):
                if longer_polarity[e, j] != 0:
                    smallest = min(smallest, half - half * longer_polarity[e, j] * voltage[longer_variables[e, j], k])
            longer_memory[e, k] = c[4] + smallest
            longer_memory[e, LANES + k] = longer_long[e, k]
    x, field, true = np.empty((n, LANES), F32), np.empty((n, LANES), F32), np.zeros((n_longer, LANES), np.int32)
    tried, tried_field, tried_true = np.empty((n, 1), F32), np.empty((n, 1), F32), np.zeros((n_longer, 1), np.int32)
    energy, lowest, found_at = np.zeros(LANES), np.full(LANES, np.inf), np.zeros(LANES, np.int64)
    elapsed = np.zeros(LANES)
    dt, fastest, changed = np.zeros(LANES, F32), np.empty(LANES, F32), np.ones(LANES, np.bool_)
    for k in range(LANES):
        for i in range(n):
            x[i, k] = one if voltage[i, k] > 0 else F32(0)
        energy[k] = local_fields(digital, linear, pairs, x, field, true, k)
    counter = np.uint64(0)
    for step in range(n_steps + 1):
        if step > 0:
            for i in range(n):
                for k in range(LANES):
                    if (voltage[i, k] > 0) != (x[i, k] > half):
                        energy[k] += flip(digital, x, field, true, i, k)
                        changed[k] = True
            if step % REFRESH == 0:
                for k in range(LANES):
                    energy[k] = local_fields(digital, linear, pairs, x, field, true, k)
        for k in range(LANES):
            if changed[k] and energy[k] < lowest[k]:
                lowest[k], found_at[k] = energy[k], step
                best[k] = x[:, k]
            if changed[k] and quench_every > 0 and step % quench_every == 0:
                tried[:, 0] = x[:, k]
                tried_field[:, 0] = field[:, k]
                tried_true[:, 0] = true[:, k]
                reached = energy[k] + quench(digital, tried, tried_field, tried_true)
                if reached < lowest[k]:
                    lowest[k], found_at[k] = reached, step
                    best[k] = tried[:, 0]
                changed[k] = False
            if every > 0 and step > 0 and step % every == 0:
                at = step // every - 1
                times[k, at] = elapsed[k]
                for i in range(n):
                    states[k, at, i] = x[i, k] > half
        # One pass moves the memories by the step that led here and finds the rate of the voltages.
        rate[:] = 0
        if kind == BOND:
            bond_pass(pairs, weight, memory, voltage, rate, push, c, dt)
            bond_fields(unit, unit_short, unit_long, voltage, rate, c, dt)
        else:
            clause_pass(pairs, weight, polarity, memory, voltage, rate, push, c, dt)
            clause_units(unit, unit_long, voltage, rate, c, dt)
            longer_pass(
                longer_variables, longer_polarity, longer_weight, longer_memory, voltage, rate, falsehood, c, dt
            )
        if step == n_steps:
            break
        fastest[:] = F32(1e-30)
        for i in range(n):
            for k in range(LANES):
                fastest[k] = max(fastest[k], abs(rate[i, k]))
        for k in range(LANES):
            dt[k] = min(control[2], max(control[1], control[0] / fastest[k]))
            elapsed[k] += dt[k]
        for i in range(n):
            for k in range(LANES):
                shake = F32(0)
                if control[3] > 0:
                    shake = control[3] * math.sqrt(dt[k]) * uniform(seeds[k], counter)
                voltage[i, k] = min(one, max(-one, voltage[i, k] + dt[k] * rate[i, k] + shake))
            counter += np.uint64(1)
    for e in range(n_pairs):
        for k in range(LANES):
            long[e, k] = memory[e, LANES + k]
    for e in range(n_longer):
        for k in range(LANES):
            longer_long[e, k] = longer_memory[e, LANES + k]
    return found_at
