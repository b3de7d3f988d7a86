"""Compiled kernel for two fully coupled layers: vectors run along the rows of the coupling matrix.

One call integrates one restart, so that its memories stay in the cache and restarts run on threads. All
arrays are float32; the variables are (first layer, second layer), matrices are (n_second, n_first). The
equations are those of ``ClauseField`` and ``BondField``, the scheme is ``Splitting``.
"""

import math

import numpy as np
from numba import njit

from memcomp_lightning.dmm.kernels.common import BOND, F32, FAST_MATH, MAX_SWEEPS, REFRESH, uniform


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def clause_pass(weight, board, short, long, voltage, drive, c, dt):
    """Advance the memories of all pairs by ``dt`` at the present voltages, then add the pairs' drive.

    ``weight`` carries the polarity of the first literal as its sign; that of the second is a checkerboard,
    -(-1)^(i + j). ``short`` holds x_s + epsilon and ``long`` x_l - 1.
    """
    zero, half, one = F32(0), F32(0.5), F32(1)
    alpha, beta, gamma, delta, epsilon, zeta, cap = c[0], c[1], c[2], c[3], c[4], c[5], c[6] - one
    n_second, n_first = weight.shape
    growth, keep = dt * beta, one - dt * beta * gamma
    rise, fall = dt * alpha, -dt * alpha * delta
    top, stiff = one + epsilon, one + zeta
    v, d = voltage[:n_first], drive[:n_first]
    for i in range(n_second):
        parity = one if i % 2 == 0 else -one
        tilt = parity * half * voltage[n_first + i]
        push = zero
        w_row, short_row, long_row = weight[i], short[i], long[i]
        for j in range(n_first):
            w = w_row[j]
            sign = math.copysign(one, w)
            false_first = half - sign * (half * v[j])
            false_second = half + board[j] * tilt
            unsatisfied = min(false_first, false_second)
            s = min(top, max(epsilon, short_row[j] * (keep + growth * unsatisfied)))
            x = long_row[j]
            excess = fall + rise * unsatisfied
            x = min(cap, max(F32(0), x + excess * (one if excess > zero else x)))
            short_row[j] = s
            long_row[j] = x
            size = abs(w)
            agile = size * (s - epsilon)
            gradient = agile + agile * x
            rigidity = (size - agile) * unsatisfied * (stiff + zeta * x)
            at_first = rigidity if false_first <= false_second else zero
            d[j] += sign * (gradient * false_second + at_first)
            push -= board[j] * (gradient * false_first + (rigidity - at_first))
        drive[n_first + i] += parity * push


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def clause_units(unit, long, voltage, drive, c, dt):
    """Advance the memories of the unit clauses and add their pull."""
    half, one = F32(0.5), F32(1)
    alpha, delta, cap, pull = c[0], c[3], c[6] - one, c[7]
    for i in range(unit.size):
        u = unit[i]
        sign = half if u > 0 else (-half if u < 0 else F32(0))
        excess = dt * alpha * (half - sign * voltage[i] - delta)
        x = long[i]
        long[i] = min(cap, max(F32(0), x + excess * (one if excess > 0 else x)))
        drive[i] += pull * u * (one + long[i])


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def bond_pass(bond, short, long, voltage, drive, pull, c, dt):
    """Advance the memories of all bonds by ``dt`` at the present voltages, then add their drive and pull.

    ``long`` holds Y - 1.
    """
    zero, one = F32(0), F32(1)
    gamma, kappa, delta, zeta, low, cap = c[2], c[3], c[4], c[5], c[6], c[7] - one
    n_second, n_first = bond.shape
    v, d, p = voltage[:n_first], drive[:n_first], pull[:n_first]
    growth, lift = dt * gamma - dt, dt * gamma * kappa
    # Where X <= 1 cannot lift Y from its lower bound, Y stays there and need not be read.
    frozen = delta <= zeta
    for i in range(n_second):
        h = voltage[n_first + i]
        weighted = lift * h
        push, strain = zero, zero
        bond_row, short_row, long_row = bond[i], short[i], long[i]
        if frozen:
            for j in range(n_first):
                w = bond_row[j]
                sign = one if w > zero else (-one if w < zero else zero)
                x = min(one, max(low, short_row[j] + growth + weighted * (sign * v[j])))
                short_row[j] = x
                strength = abs(w) * x
                d[j] += w * h
                push += w * v[j]
                p[j] += strength
                strain += strength
        else:
            for j in range(n_first):
                w = bond_row[j]
                sign = one if w > zero else (-one if w < zero else zero)
                x = short_row[j]
                y = long_row[j]
                long_row[j] = min(cap, max(zero, y + dt * (delta * x - zeta)))
                x = min(one, max(low, x + growth - dt * y + weighted * (sign * v[j])))
                short_row[j] = x
                strength = abs(w) * x
                d[j] += w * h
                push += w * v[j]
                p[j] += strength
                strain += strength
        drive[n_first + i] += push
        pull[n_first + i] += strain


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def bond_fields(field, short, long, voltage, drive, pull, c, dt):
    """Advance the memories of the fields, then turn drive and pull into the rate of the voltages."""
    zero, one = F32(0), F32(1)
    alpha, gamma, kappa, delta, zeta, low, cap = c[0], c[2], c[3], c[4], c[5], c[6], c[7] - one
    pull_rate = F32(2) * c[1] / c[9]
    for i in range(field.size):
        h = field[i]
        sign = one if h > zero else (-one if h < zero else zero)
        x, y = short[i], long[i]
        long[i] = min(cap, max(zero, y + dt * (delta * x - zeta)))
        short[i] = min(one, max(low, x + dt * (gamma * (one + kappa * sign * voltage[i]) - one - y)))
        drive[i] = alpha * (drive[i] + h) - pull_rate * (pull[i] + abs(h) * short[i]) * voltage[i]


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def flip(coupling, transposed, x, field, i):
    """Flip one variable; return the change of energy."""
    n_first = coupling.shape[1]
    change = F32(1) - F32(2) * x[i]
    gain = change * field[i]
    x[i] += change
    if i < n_first:
        row, other = transposed[i], field[n_first:]
    else:
        row, other = coupling[i - n_first], field[:n_first]
    for j in range(row.size):
        other[j] += change * row[j]
    return gain


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def local_fields(coupling, linear, x, field):
    """Write the local fields of a digital state from scratch; return its energy."""
    n_second, n_first = coupling.shape
    energy = 0.0
    for j in range(linear.size):
        field[j] = linear[j]
        energy += linear[j] * x[j]
    first, out = x[:n_first], field[:n_first]
    for i in range(n_second):
        total, on, row = F32(0), x[n_first + i], coupling[i]
        for j in range(n_first):
            total += row[j] * first[j]
            out[j] += row[j] * on
        field[n_first + i] += total
        energy += total * on
    return energy


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def quench(coupling, transposed, x, field):
    """Flip single variables as long as each flip lowers the energy; return the change."""
    total, one, two = 0.0, F32(1), F32(2)
    for _ in range(MAX_SWEEPS):
        # A vector loop finds out whether anything moves; the sweep itself goes one by one.
        eager = 0
        for i in range(x.size):
            eager += 1 if (one - two * x[i]) * field[i] < 0 else 0
        if eager == 0:
            break
        for i in range(x.size):
            if (one - two * x[i]) * field[i] < 0:
                total += flip(coupling, transposed, x, field, i)
    return total


@njit(nogil=True, cache=True)
def integrate_all(begin, end, stop, problem, control, start, steps, best, found_at, times, states):
    """Integrate the restarts numbered ``begin`` to ``end - 1``, problem by problem.

    Args:
        begin: First restart.
        end: Behind the last restart.
        stop: One number; anything but 0 ends the integration at the next step.
        problem: (kind, constants, weight, unit, coupling, transposed, linear), the last six a problem each.
        control: (max_change, dt_min, dt_max, noise), a problem each.
        start: (voltage, long, unit_long, seed), each ``(n_problems, n_restarts, ...)``.
        steps: (n_steps, quench_every, record_every), 0 for never.
        best: Out, ``(n_problems, n_restarts, n)``.
        found_at: Out, ``(n_problems, n_restarts)``.
        times: Out, ``(n_problems, n_restarts, n_records)``.
        states: Out, ``(n_problems, n_restarts, n_records, n)``.
    """
    kind, constants, weight, unit, coupling, transposed, linear = problem
    voltage, long, unit_long, seed = start
    n_restarts = voltage.shape[1]
    for item in range(begin, end):
        if stop[0] != 0:
            return
        p, r = item // n_restarts, item % n_restarts
        found_at[p, r] = integrate(
            (kind, weight[p], unit[p], coupling[p], transposed[p], linear[p]),
            constants[p],
            control[p],
            voltage[p, r],
            long[p, r],
            unit_long[p, r],
            seed[p, r],
            steps,
            stop,
            best[p, r],
            times[p, r],
            states[p, r],
        )


@njit(nogil=True, cache=True, fastmath=FAST_MATH)
def integrate(problem, c, control, voltage, long, unit_long, seed, steps, stop, best, times, states):
    """Integrate one restart; return the step at which ``best`` was met, 0 for the initial state.

    Args:
        problem: (kind, weight or bond, unit or field, coupling, its transpose, linear).
        c: Constants of the field, in the order of ``cpu._constants``.
        control: (max_change, dt_min, dt_max, noise).
        voltage: ``(n,)``; initial values in, final values out.
        long: Long-term memories ``(n_second, n_first)`` less 1, in and out.
        unit_long: Those of the unit clauses or fields, ``(n,)``, in and out.
        seed: Of the noise.
        steps: (n_steps, quench_every, record_every); quench_every = 0 reads each step without a quench.
        stop: One number; anything but 0 ends the integration.
        best: ``(n,)``, out: the assignment of lowest energy.
        times: ``(n_records,)``, out.
        states: ``(n_records, n)``, out.
    """
    kind, weight, unit, coupling, transposed, linear = problem
    n_steps, quench_every, every = steps
    half, one = F32(0.5), F32(1)
    n_second, n_first = weight.shape
    n = n_first + n_second
    drive, pull = np.zeros(n, F32), np.zeros(n, F32)
    short, unit_short = np.empty((n_second, n_first), F32), np.full(n, c[8], F32)
    board = np.empty(n_first, F32)
    for j in range(n_first):
        board[j] = one if j % 2 == 0 else -one
    for i in range(n_second):
        tilt = (one if i % 2 == 0 else -one) * half * voltage[n_first + i]
        for j in range(n_first):
            false_second = half + board[j] * tilt
            false_first = half - math.copysign(half, weight[i, j]) * voltage[j]
            short[i, j] = c[8] if kind == BOND else c[4] + min(false_first, false_second)
    x, field = np.empty(n, F32), np.empty(n, F32)
    tried, tried_field = np.empty(n, F32), np.empty(n, F32)
    for i in range(n):
        x[i] = one if voltage[i] > 0 else F32(0)
    energy = local_fields(coupling, linear, x, field)
    lowest, found_at, elapsed = 1e300, 0, 0.0
    dt, changed, n_reads, counter = F32(0), True, 0, np.uint64(0)
    for step in range(n_steps + 1):
        recorded = every > 0 and step > 0 and step % every == 0
        reads = quench_every == 0 or step % quench_every == 0
        if step > 0 and (reads or recorded):
            n_changed = 0
            for i in range(n):
                n_changed += 1 if (voltage[i] > 0) != (x[i] > half) else 0
            if n_changed > 0:
                changed = True
                for i in range(n):
                    if (voltage[i] > 0) != (x[i] > half):
                        energy += flip(coupling, transposed, x, field, i)
            n_reads += 1
            if n_reads % REFRESH == 0:
                energy = local_fields(coupling, linear, x, field)
        if reads and changed and energy < lowest:
            lowest = energy
            new = False
            for i in range(n):
                new |= best[i] != x[i]
            if new or step == 0:
                found_at = step
                best[:] = x
        if reads and changed and quench_every > 0:
            tried[:] = x
            tried_field[:] = field
            reached = energy + quench(coupling, transposed, tried, tried_field)
            if reached < lowest:
                lowest = reached
                new = False
                for i in range(n):
                    new |= best[i] != tried[i]
                if new or step == 0:
                    found_at = step
                    best[:] = tried
            changed = False
        if recorded:
            times[step // every - 1] = elapsed
            for i in range(n):
                states[step // every - 1, i] = x[i] > half
        # One pass moves the memories by the step that led here and finds the rate of the voltages.
        drive[:] = 0
        if kind == BOND:
            pull[:] = 0
            bond_pass(weight, short, long, voltage, drive, pull, c, dt)
            bond_fields(unit, unit_short, unit_long, voltage, drive, pull, c, dt)
        else:
            clause_pass(weight, board, short, long, voltage, drive, c, dt)
            clause_units(unit, unit_long, voltage, drive, c, dt)
        if step == n_steps or stop[0] != 0:
            break
        fastest = F32(1e-30)
        for i in range(n):
            fastest = max(fastest, abs(drive[i]))
        dt = min(control[2], max(control[1], control[0] / fastest))
        for i in range(n):
            voltage[i] += dt * drive[i]
        if control[3] > 0:
            width = control[3] * F32(math.sqrt(dt))
            for i in range(n):
                voltage[i] += width * uniform(seed, counter + np.uint64(i))
            counter += np.uint64(n)
        for i in range(n):
            voltage[i] = min(one, max(-one, voltage[i]))
        elapsed += dt
    return found_at
