"""Compiled kernel for two fully coupled layers: vectors run along the rows of the coupling matrix.

One call integrates one restart, so that its memories stay in the cache and restarts run on threads. All
arrays are float32; the variables are (first layer, second layer), matrices are (n_second, n_first). The
equations are those of ``ClauseField`` and ``BondField``, the scheme is ``Splitting``.

Matrices are passed flat and read at unsigned offsets: a signed one could count from the end, which prevents vector
code.
"""

import math

import numpy as np
from numba import njit

from memcomp_lightning.solvers.dmm.kernels.common import (
    ALPHA,
    BETA,
    BOND,
    CHANGE,
    DELTA,
    DT_MAX,
    DT_MIN,
    EPSILON,
    F32,
    FAST_MATH,
    GAMMA,
    KAPPA,
    LAG,
    LONG_TERM_MAX,
    NOISE,
    PULL_SCALE,
    SHORT_TERM_MIN,
    SHORT_TERM_START,
    TINY,
    ZETA,
    clause,
    clause_rates,
    inlined,
    uniform,
    unit_clause,
    unit_rates,
)
from memcomp_lightning.solvers.dmm.kernels.digital import (
    REFRESH,
    copy,
    keep_better,
    local_fields_matrix,
    quench_matrix,
    read_out_matrix,
)

U64 = np.uint64


@inlined
def clause_pass(n_first, n_second, weight, side, short, long, voltage, drive, c, dt):
    """Advance the memories of all pairs by ``dt`` at the present voltages, then add the pairs' drive.

    ``weight`` carries the polarity of the first literal as its sign. That of the second is -1 where both variables
    are in the first halves of their layers, or in the second ones; ``side`` is 1/2 in the first half of the first
    layer, else -1/2. ``short`` holds x_s + epsilon and ``long`` x_l - 1.
    """
    rates, half, one, two, row = clause_rates(c, dt), F32(0.5), U64(1), U64(2), U64(0)
    for i in range(U64(0), n_second, two):
        # Two rows at a time: what a row costs besides its pairs is most of the time of a short one.
        above, below = two * i >= n_second, two * (i + one) >= n_second
        h, g = voltage[n_first + i], voltage[n_first + i + one]
        h, g = -h if above else h, -g if below else g
        push, push_below = F32(0), F32(0)
        for j in range(n_first):
            at, v, s = row + j, voltage[j], side[j]
            w, after = weight[at], at + n_first
            u = weight[after]
            short[at], long[at], first, second = clause(
                half - math.copysign(half, w) * v, half + s * h, short[at], long[at], rates
            )
            short[after], long[after], first_below, second_below = clause(
                half - math.copysign(half, u) * v, half + s * g, short[after], long[after], rates
            )
            drive[j] += w * first + u * first_below
            push -= s * (abs(w) * second)
            push_below -= s * (abs(u) * second_below)
        drive[n_first + i] += -(push + push) if above else push + push
        drive[n_first + i + one] += -(push_below + push_below) if below else push_below + push_below
        row += two * n_first


@inlined
def clause_units(unit, long, voltage, drive, c, dt):
    """Advance the memories of the unit clauses and add their pull."""
    rates = unit_rates(c)
    for i in range(unit.size):
        long[i], pull = unit_clause(unit[i], voltage[i], long[i], rates, dt)
        drive[i] += pull


@inlined
def bond_pass(n_first, n_second, bond, short, long, voltage, drive, pull, c, dt):
    """Advance the memories of all bonds by ``dt`` at the present voltages, then add their drive and pull.

    ``long`` holds Y - 1.
    """
    zero, one = F32(0), F32(1)
    gamma, kappa, delta, zeta = c[GAMMA], c[KAPPA], c[DELTA], c[ZETA]
    low, cap = c[SHORT_TERM_MIN], c[LONG_TERM_MAX] - one
    growth, lift = dt * gamma - dt, dt * gamma * kappa
    # Where X <= 1 cannot lift Y from its lower bound, Y stays there and need not be read.
    frozen = delta <= zeta
    row = U64(0)
    for i in range(n_second):
        h = voltage[n_first + i]
        weighted = lift * h
        push, strain = zero, zero
        if frozen:
            for j in range(n_first):
                at = row + j
                w = bond[at]
                sign = one if w > zero else (-one if w < zero else zero)
                x = min(one, max(low, short[at] + growth + weighted * (sign * voltage[j])))
                short[at] = x
                strength = abs(w) * x
                drive[j] += w * h
                push += w * voltage[j]
                pull[j] += strength
                strain += strength
        else:
            for j in range(n_first):
                at = row + j
                w, x, y = bond[at], short[at], long[at]
                sign = one if w > zero else (-one if w < zero else zero)
                long[at] = min(cap, max(zero, y + dt * (delta * x - zeta)))
                x = min(one, max(low, x + growth - dt * y + weighted * (sign * voltage[j])))
                short[at] = x
                strength = abs(w) * x
                drive[j] += w * h
                push += w * voltage[j]
                pull[j] += strength
                strain += strength
        drive[n_first + i] += push
        pull[n_first + i] += strain
        row += n_first


@inlined
def bond_fields(field, short, long, voltage, drive, pull, c, dt):
    """Advance the memories of the fields, then turn drive and pull into the rate of the voltages."""
    zero, one = F32(0), F32(1)
    alpha, gamma, kappa, delta, zeta = c[ALPHA], c[GAMMA], c[KAPPA], c[DELTA], c[ZETA]
    low, cap = c[SHORT_TERM_MIN], c[LONG_TERM_MAX] - one
    pull_rate = F32(2) * c[BETA] / c[PULL_SCALE]
    for i in range(field.size):
        h = field[i]
        sign = one if h > zero else (-one if h < zero else zero)
        x, y = short[i], long[i]
        long[i] = min(cap, max(zero, y + dt * (delta * x - zeta)))
        short[i] = min(one, max(low, x + dt * (gamma * (one + kappa * sign * voltage[i]) - one - y)))
        drive[i] = alpha * (drive[i] + h) - pull_rate * (pull[i] + abs(h) * short[i]) * voltage[i]


@inlined
def start_short(n_first, n_second, weight, side, short, voltage, epsilon):
    """Write x_s(0) + epsilon = C(0) + epsilon."""
    half, row = F32(0.5), U64(0)
    for i in range(U64(short.size) // n_first):
        h = voltage[n_first + i]
        if U64(2) * i >= n_second:
            h = -h
        for j in range(n_first):
            false_first = half - math.copysign(half, weight[row + j]) * voltage[j]
            short[row + j] = epsilon + min(false_first, half + side[j] * h)
        row += n_first


@njit(nogil=True, cache=True)
def integrate_all(begin, end, stop, problem, control, start, steps, best, found_at, last, times, states):
    """Integrate the restarts numbered ``begin`` to ``end - 1``, problem by problem.

    Layers are padded to whole vectors with variables that nothing moves; ``n_first`` and ``n_second`` count them.

    Args:
        begin: First restart.
        end: Behind the last restart.
        stop: One number; anything but 0 ends the integration at the next step.
        problem: (kind, sizes, side, constants, weight, unit, coupling, transposed, linear), the last six a problem
            each, matrices flat; sizes are n_first, n_second, and how many of both are no padding.
        control: Step control, named in ``common.CONTROL``, ``(n_problems, 5)``.
        start: (voltage, long, unit_long, seed), each ``(n_problems, n_restarts, ...)``; where ``long`` has size 0
            in place of n_restarts, memories begin at rest and are not returned.
        steps: (n_steps, quench_every, record_every, min_steps, stall), see :func:`integrate`.
        best: Out, ``(n_problems, n_restarts, n)``.
        found_at: Out, the step at which it was met, ``(n_problems, n_restarts)``; 0 for the initial state.
        last: Out, the number of steps done, ``(n_problems, n_restarts)``.
        times: Out, ``(n_problems, n_restarts, n_records)``.
        states: Out, ``(n_problems, n_restarts, n_records, n)``.
    """
    kind, sizes, side, constants, weight, unit, coupling, transposed, linear = problem
    n_first, n_second, columns, rows = sizes
    sizes = (U64(n_first), U64(n_second), U64(columns), U64(rows))
    voltage, long, unit_long, seed = start
    n_restarts = voltage.shape[1]
    fresh = long.shape[1] == 0
    at_rest, unit_at_rest = np.empty(weight.shape[1], F32), np.empty(unit.shape[1], F32)
    for item in range(begin, end):
        if stop[0] != 0:
            return
        p, r = item // n_restarts, item % n_restarts
        if fresh:
            at_rest[:] = 0
            unit_at_rest[:] = 0
        found_at[p, r], last[p, r] = integrate(
            (kind, sizes, side, weight[p], unit[p], coupling[p], transposed[p], linear[p]),
            constants[p],
            control[p],
            voltage[p, r],
            at_rest if fresh else long[p, r],
            unit_at_rest if fresh else unit_long[p, r],
            seed[p, r],
            steps,
            stop,
            best[p, r],
            times[p, r],
            states[p, r],
        )


@njit(nogil=True, cache=True, fastmath=FAST_MATH, forceinline=True)
def integrate(problem, c, control, voltage, long, unit_long, seed, steps, stop, best, times, states):
    """Integrate one restart; return the step at which ``best`` was met, and the last step.

    Args:
        problem: (kind, sizes, side, weight or bond, unit or field, coupling, its transpose, linear).
        c: Constants of the field, named in ``common.CONSTANTS``.
        control: Named in ``common.CONTROL``.
        voltage: ``(n,)``; initial values in, final values out.
        long: Long-term memories less 1, in and out.
        unit_long: Those of the unit clauses or fields, ``(n,)``, in and out.
        seed: Of the noise.
        steps: (n_steps, quench_every, record_every, min_steps, stall); quench_every = 0 reads each step without a
            quench. The restart ends at a reading from step min_steps + stall found_at on.
        stop: One number; anything but 0 ends the integration.
        best: ``(n,)``, out: the assignment of lowest energy.
        times: ``(n_records,)``, out.
        states: ``(n_records, n)``, out.
    """
    kind, sizes, side, weight, unit, coupling, transposed, linear = problem
    n_first, n_second, columns, rows = sizes
    n_steps, quench_every, every, min_steps, stall = steps
    half, one = F32(0.5), F32(1)
    n = voltage.size
    drive, pull, before = np.zeros(n, F32), np.zeros(n, F32), np.zeros(n, F32)
    unit_short = np.full(n, c[SHORT_TERM_START], F32)
    if kind == BOND:
        short = np.full(weight.size, c[SHORT_TERM_START], F32)
    else:
        short = np.empty(weight.size, F32)
        start_short(n_first, rows, weight, side, short, voltage, c[EPSILON])
    x, field = np.empty(n, F32), np.empty(n, F32)
    tried, tried_field, found = np.empty(n, F32), np.empty(n, F32), np.empty(n + 1, np.uint64)
    for i in range(n):
        x[i] = one if voltage[i] > 0 else F32(0)
    energy = local_fields_matrix(n_first, n_second, coupling, linear, x, field)
    lowest, found_at, elapsed = 1e300, 0, 0.0
    dt, changed, n_reads, counter = F32(0), True, 0, U64(0)
    for step in range(n_steps + 1):
        recorded = every > 0 and step > 0 and step % every == 0
        reads = quench_every == 0 or step % quench_every == 0
        if step > 0 and (reads or recorded):
            energy, n_changed = read_out_matrix(
                n_first, n_second, coupling, transposed, linear, voltage, x, field, energy, found
            )
            changed = changed or n_changed > 0
            n_reads += 1
            if n_reads % REFRESH == 0:
                energy = local_fields_matrix(n_first, n_second, coupling, linear, x, field)
        if reads and changed:
            lowest, found_at = keep_better(energy, lowest, x, best, step, found_at)
            if quench_every > 0:
                copy(x, tried)
                copy(field, tried_field)
                reached = energy + quench_matrix(
                    n_first, n_second, coupling, transposed, tried, tried_field, found
                )
                lowest, found_at = keep_better(reached, lowest, tried, best, step, found_at)
            changed = False
        if recorded:
            times[step // every - 1] = elapsed
            for i in range(n):
                states[step // every - 1, i] = x[i] > half
        # One pass moves the memories by the step that led here and finds the rate of the voltages.
        drive[:] = 0
        if kind == BOND:
            pull[:] = 0
            bond_pass(n_first, rows, weight, short, long, voltage, drive, pull, c, dt)
            bond_fields(unit, unit_short, unit_long, voltage, drive, pull, c, dt)
        else:
            clause_pass(n_first, rows, weight, side, short, long, voltage, drive, c, dt)
            clause_units(unit, unit_long, voltage, drive, c, dt)
        if step == n_steps or stop[0] != 0 or (reads and step >= min_steps + stall * found_at):
            break
        lag = control[LAG] if step > 0 else F32(0)
        size = F32(0)
        for i in range(n):
            rate = drive[i]
            drive[i] += lag * (before[i] - rate)
            before[i] = rate
            size += drive[i] * drive[i]
        dt = min(control[DT_MAX], max(control[DT_MIN], control[CHANGE] / max(F32(math.sqrt(size / F32(n))), TINY)))
        for i in range(n):
            voltage[i] += dt * drive[i]
        if control[NOISE] > 0:
            width = control[NOISE] * F32(math.sqrt(dt))
            for i in range(columns):
                voltage[i] += width * uniform(seed, counter + i)
            for i in range(rows):
                voltage[n_first + i] += width * uniform(seed, counter + columns + i)
            counter += columns + rows
        for i in range(n):
            voltage[i] = min(one, max(-one, voltage[i]))
        elapsed += dt
    return found_at, step
