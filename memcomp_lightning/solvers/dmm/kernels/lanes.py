"""Compiled kernel for listed pairs and longer clauses: vectors run along the restarts.

One call integrates a block of restarts, its lanes, side by side, so that a sparse problem needs no gathers: every
number of a variable or a clause is a vector over the restarts. Time and memory are linear in the number of
pairs. All arrays are float32 with the lanes last; each lane has a step size of its own. The equations are those
of ``ClauseField`` and ``BondField``, the scheme is ``Splitting``.

The passes over the pairs read flat arrays at unsigned offsets, in loops over the lanes that write one array
each: only then does the compiler make vector code of them.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numba.extending import overload

from memcomp_lightning.solvers.dmm.kernels.common import (
    ALPHA,
    BETA,
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
    UNIT_PULL,
    ZETA,
    clause,
    clause_rates,
    inlined,
    uniform,
)
from memcomp_lightning.solvers.dmm.kernels.digital import (
    REFRESH,
    copy,
    keep_better,
    local_fields_listed,
    quench_listed,
    read_out_listed,
    transpose_signs,
)

if TYPE_CHECKING:
    from memcomp_lightning.solvers.dmm.kernels.fields import Compiled

U64 = np.uint64


@njit(nogil=True, cache=True, fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def clause_pass(pairs, weight, polarity, memory, voltage, rate, push, c, dt):
    """Advance the memories of all pairs by ``dt`` at the present voltages, then add the pairs' drive to ``rate``.

    ``memory`` holds x_s + epsilon and x_l - 1 of each pair, ``(n_pairs, 2, lanes)``; ``push`` is scratch.
    """
    half, lanes = F32(0.5), U64(dt.size)
    m, v, r = memory.ravel(), voltage.ravel(), rate.ravel()
    for e in range(weight.size):
        w, second = math.copysign(weight[e], polarity[e, 0]), polarity[e, 1]
        a, b, short = U64(pairs[e, 0]) * lanes, U64(pairs[e, 1]) * lanes, U64(2 * e) * lanes
        long = short + lanes
        for k in range(lanes):
            m[short + k], m[long + k], at_first, at_second = clause(
                w, v[a + k], half - half * second * v[b + k], m[short + k], m[long + k], clause_rates(c, dt[k])
            )
            push[k] = at_first
            push[lanes + k] = second * at_second
        a, b = a + a, b + b
        for k in range(lanes):
            r[a + k] += push[k]
        for k in range(lanes):
            r[b + k] += push[lanes + k]


@njit(nogil=True, cache=True, fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def bond_pass(pairs, bond, memory, voltage, rate, push, c, dt):
    """Advance the memories of all bonds by ``dt`` at the present voltages, then add their drive and pull.

    ``memory`` holds X and Y - 1 of each bond, ``rate`` the drive and the pull of each spin, ``(..., 2, lanes)``.
    """
    zero, one = F32(0), F32(1)
    gamma, kappa, delta, zeta = c[GAMMA], c[KAPPA], c[DELTA], c[ZETA]
    low, cap = c[SHORT_TERM_MIN], c[LONG_TERM_MAX] - one
    lift = gamma - one
    lanes = U64(dt.size)
    m, v, r = memory.ravel(), voltage.ravel(), rate.ravel()
    for e in range(bond.size):
        w = bond[e]
        size = abs(w)
        satisfied = gamma * kappa * (one if w > zero else (-one if w < zero else zero))
        a, b, short = U64(pairs[e, 0]) * lanes, U64(pairs[e, 1]) * lanes, U64(2 * e) * lanes
        long = short + lanes
        for k in range(lanes):
            x, y = m[short + k], m[long + k]
            m[long + k] = min(cap, max(zero, y + dt[k] * (delta * x - zeta)))
            x = min(one, max(low, x + dt[k] * (lift - y + satisfied * (v[a + k] * v[b + k]))))
            m[short + k] = x
            push[k] = size * x
        drive_a, drive_b = a + a, b + b
        for k in range(lanes):
            r[drive_a + k] += w * v[b + k]
        for k in range(lanes):
            r[drive_b + k] += w * v[a + k]
        pull_a, pull_b = drive_a + lanes, drive_b + lanes
        for k in range(lanes):
            r[pull_a + k] += push[k]
        for k in range(lanes):
            r[pull_b + k] += push[k]


@njit(nogil=True, cache=True, fastmath=FAST_MATH, error_model="numpy", forceinline=True)
def longer_pass(longer, memory, voltage, rate, falsehood, scratch, c, dt):
    """Do what ``clause_pass`` does, for clauses of three literals and more, padded with polarity 0.

    ``falsehood`` and ``scratch`` hold intermediate results.
    """
    zero, half, one = F32(0), F32(0.5), F32(1)
    alpha, beta, gamma, delta, epsilon = c[ALPHA], c[BETA], c[GAMMA], c[DELTA], c[EPSILON]
    cap = c[LONG_TERM_MAX] - one
    variables, polarity, weight = longer
    lanes = U64(dt.size)
    m, v, r, f = memory.ravel(), voltage.ravel(), rate.ravel(), falsehood.ravel()
    smallest, next_smallest, at, gradient, rigidity = scratch
    for e in range(weight.size):
        w, short = weight[e], U64(2 * e) * lanes
        long = short + lanes
        smallest[:] = one + one
        next_smallest[:] = one + one
        for i in range(variables.shape[1]):
            q = polarity[e, i]
            if q != 0:
                literal, a, number = U64(i) * lanes, U64(variables[e, i]) * lanes, F32(i)
                for k in range(lanes):
                    f[literal + k] = half - half * q * v[a + k]
                for k in range(lanes):
                    next_smallest[k] = min(next_smallest[k], max(f[literal + k], smallest[k]))
                for k in range(lanes):
                    at[k] = number if f[literal + k] < smallest[k] else at[k]
                for k in range(lanes):
                    smallest[k] = min(f[literal + k], smallest[k])
        for k in range(lanes):
            excess = dt[k] * beta * (smallest[k] - gamma)
            m[short + k] = min(one + epsilon, max(epsilon, m[short + k] * (one + excess)))
        for k in range(lanes):
            excess, x = dt[k] * alpha * (smallest[k] - delta), m[long + k]
            m[long + k] = min(cap, max(zero, x + excess * (one if excess > zero else x)))
        for k in range(lanes):
            gradient[k] = w * (m[short + k] - epsilon) * (one + m[long + k])
        for k in range(lanes):
            rigidity[k] = w * (one + epsilon - m[short + k]) * smallest[k]
        for i in range(variables.shape[1]):
            q = polarity[e, i]
            if q != 0:
                a, number = U64(2 * variables[e, i]) * lanes, F32(i)
                for k in range(lanes):
                    at_first = gradient[k] * next_smallest[k] + rigidity[k]
                    r[a + k] += q * (at_first if at[k] == number else gradient[k] * smallest[k])


@inlined
def clause_units(unit, long, voltage, rate, c, dt):
    """Advance the memories of the unit clauses and add their pull."""
    half, one = F32(0.5), F32(1)
    alpha, delta, cap, strength = c[ALPHA], c[DELTA], c[LONG_TERM_MAX] - one, c[UNIT_PULL]
    for i in range(unit.size):
        u = unit[i]
        sign = half if u > 0 else (-half if u < 0 else F32(0))
        for k in range(dt.size):
            excess = dt[k] * alpha * (half - sign * voltage[i, k] - delta)
            long[i, k] = min(cap, max(F32(0), long[i, k] + excess * (one if excess > 0 else long[i, k])))
        for k in range(dt.size):
            rate[i, 0, k] += strength * u * (one + long[i, k])


@inlined
def bond_fields(field, short, long, voltage, rate, c, dt):
    """Advance the memories of the fields, then turn drive and pull into the rate of the voltages."""
    zero, one = F32(0), F32(1)
    alpha, gamma, kappa, delta, zeta = c[ALPHA], c[GAMMA], c[KAPPA], c[DELTA], c[ZETA]
    low, cap = c[SHORT_TERM_MIN], c[LONG_TERM_MAX] - one
    pull_rate = F32(2) * c[BETA] / c[PULL_SCALE]
    for i in range(field.size):
        h = field[i]
        size = abs(h)
        sign = one if h > zero else (-one if h < zero else zero)
        for k in range(dt.size):
            x, y = short[i, k], long[i, k]
            long[i, k] = min(cap, max(zero, y + dt[k] * (delta * x - zeta)))
            short[i, k] = min(one, max(low, x + dt[k] * (gamma * (one + kappa * sign * voltage[i, k]) - one - y)))
        for k in range(dt.size):
            pull = rate[i, 1, k] + size * short[i, k]
            rate[i, 0, k] = alpha * (rate[i, 0, k] + h) - pull_rate * pull * voltage[i, k]


@inlined
def clause_start(problem, memories, voltage, c):
    """Short-term memories begin at x_s(0) = C(0): how far each clause is from being satisfied."""
    _, pairs, _, polarity, _, (variables, longer_polarity, _) = problem
    memory, _, _, longer_memory = memories
    half, one = F32(0.5), F32(1)
    for e in range(memory.shape[0]):
        for k in range(voltage.shape[1]):
            false_first = half - half * polarity[e, 0] * voltage[pairs[e, 0], k]
            false_second = half - half * polarity[e, 1] * voltage[pairs[e, 1], k]
            memory[e, 0, k] = c[EPSILON] + min(false_first, false_second)
    for e in range(longer_memory.shape[0]):
        for k in range(voltage.shape[1]):
            unsatisfied = one
            for j in range(variables.shape[1]):
                sign = longer_polarity[e, j]
                if sign != 0:
                    unsatisfied = min(unsatisfied, half - half * sign * voltage[variables[e, j], k])
            longer_memory[e, 0, k] = c[EPSILON] + unsatisfied


@njit(nogil=True, cache=True, fastmath=FAST_MATH, forceinline=True)
def clause_advance(problem, memories, voltage, rate, scratch, c, dt):
    """Clauses of two literals, of one, and of more."""
    _, pairs, weight, polarity, unit, longer = problem
    memory, _, unit_long, longer_memory = memories
    push, falsehood, numbers = scratch
    clause_pass(pairs, weight, polarity, memory, voltage, rate, push, c, dt)
    clause_units(unit, unit_long, voltage, rate, c, dt)
    longer_pass(longer, longer_memory, voltage, rate, falsehood, numbers, c, dt)


@inlined
def bond_start(problem, memories, voltage, c):
    """All short-term memories begin at ``short_term_start``."""
    memory, unit_short, _, _ = memories
    for e in range(memory.shape[0]):
        for k in range(voltage.shape[1]):
            memory[e, 0, k] = c[SHORT_TERM_START]
    unit_short[:] = c[SHORT_TERM_START]


@njit(nogil=True, cache=True, fastmath=FAST_MATH, forceinline=True)
def bond_advance(problem, memories, voltage, rate, scratch, c, dt):
    """Bonds, then fields."""
    _, pairs, bond, _, field, _ = problem
    memory, field_short, field_long, _ = memories
    bond_pass(pairs, bond, memory, voltage, rate, scratch[0], c, dt)
    bond_fields(field, field_short, field_long, voltage, rate, c, dt)


def start(kind, problem, memories, voltage, c):
    """What the field of this kind does at the first voltages; see :class:`fields.Compiled`."""
    return passes_of(type(kind)).start(problem, memories, voltage, c)


def advance(kind, problem, memories, voltage, rate, scratch, c, dt):
    """What the field of this kind does in each step."""
    return passes_of(type(kind)).advance(problem, memories, voltage, rate, scratch, c, dt)


# The type of the kind decides when the kernel is compiled; without numba's compilation, the functions above do.
@overload(start, jit_options={"forceinline": True, "fastmath": FAST_MATH})
def _start(kind, problem, memories, voltage, c):
    chosen = passes_of(kind.instance_class).start

    def call(kind, problem, memories, voltage, c):
        chosen(problem, memories, voltage, c)

    return call


@overload(advance, jit_options={"forceinline": True, "fastmath": FAST_MATH})
def _advance(kind, problem, memories, voltage, rate, scratch, c, dt):
    chosen = passes_of(kind.instance_class).advance

    def call(kind, problem, memories, voltage, rate, scratch, c, dt):
        chosen(problem, memories, voltage, rate, scratch, c, dt)

    return call


def passes_of(kind: type) -> "Compiled":
    """The row of :data:`fields.FIELDS` for a type of kind."""
    from memcomp_lightning.solvers.dmm.kernels.fields import FIELDS  # which imports the passes above

    return next(row for row in FIELDS.values() if type(row.kind) is kind)


@njit(nogil=True, cache=True)
def integrate_all(begin, end, stop, problem, control, start, steps, best, found_at, last, times, states):
    """Integrate the blocks of restarts numbered ``begin`` to ``end - 1``, problem by problem.

    Args:
        begin: First block.
        end: Behind the last block.
        stop: One number; anything but 0 ends the integration at the next step.
        problem: (kind, constants, pairs, weight, polarity, unit, longer, digital, linear); constants, weight,
            unit and linear have an axis of problems, so have the weights in longer and digital.
        control: Step control, named in ``common.CONTROL``, ``(n_problems, 5)``.
        start: (voltage, long, unit_long, longer_long), each ``(n_problems, n_blocks, ..., lanes)``, and the seed.
        steps: (n_steps, quench_every, record_every, min_steps, stall), see :func:`integrate`.
        best: Out, ``(n_problems, n_blocks, lanes, n)``.
        found_at: Out, the step at which it was met, ``(n_problems, n_blocks, lanes)``; 0 for the initial state.
        last: Out, the number of steps done, likewise.
        times: Out, ``(n_problems, n_blocks, lanes, n_records)``.
        states: Out, ``(n_problems, n_blocks, lanes, n_records, n)``.
    """
    kind, constants, pairs, weight, polarity, unit, longer, digital, linear = problem
    variables, longer_polarity, longer_weight = longer
    offsets, neighbour, edge, coupling, in_clause, clause_of, clause_weight = digital
    voltage, long, unit_long, longer_long, seed = start
    n_blocks = voltage.shape[1]
    for item in range(begin, end):
        if stop[0] != 0:
            return
        p, b = item // n_blocks, item % n_blocks
        found, ended = integrate(
            (kind, pairs, weight[p], polarity[p], unit[p], (variables, longer_polarity, longer_weight[p])),
            (
                offsets,
                neighbour,
                edge,
                coupling[p],
                in_clause,
                clause_of,
                variables,
                longer_polarity,
                clause_weight[p],
            ),
            linear[p],
            constants[p],
            control[p],
            (voltage[p, b], long[p, b], unit_long[p, b], longer_long[p, b], seed[p, b]),
            steps,
            stop,
            best[p, b],
            times[p, b],
            states[p, b],
        )
        copy(found, found_at[p, b])
        copy(ended, last[p, b])


@njit(nogil=True, cache=True, fastmath=FAST_MATH, forceinline=True)
def integrate(problem, digital, linear, c, control, begin, steps, stop, best, times, states):
    """Integrate the lanes of a block; return the step at which each one's ``best`` was met, and its last step.

    Args:
        problem: (kind, pairs, weight or bond, polarity, unit or field, the longer clauses: variables, polarity
            and weight).
        digital: What ``flip`` needs.
        linear: ``(n,)``, of the energy.
        c: Constants of the field, named in ``common.CONSTANTS``.
        control: Step control, named in ``common.CONTROL``.
        begin: (voltage, long-term memories less 1 of pairs, of units and of longer clauses), each with the lanes
            last, initial values in and final values out; and the seeds of the noise.
        steps: (n_steps, quench_every, record_every, min_steps, stall); quench_every = 0 reads each step without a
            quench. A restart rests from the first reading at or after step min_steps + stall found_at.
        stop: One number; anything but 0 ends the integration.
        best: ``(lanes, n)``, out: the assignments of lowest energy.
        times: ``(lanes, n_records)``, out.
        states: ``(lanes, n_records, n)``, out.
    """
    kind, pairs, weight, _, unit, longer = problem
    longer_variables, _, longer_weight = longer
    voltage, long, unit_long, longer_long, seeds = begin
    n_steps, quench_every, every, min_steps, stall = steps
    half, one = F32(0.5), F32(1)
    n, n_pairs, n_longer, lanes = unit.size, weight.size, longer_weight.size, voltage.shape[1]
    rate, push = np.zeros((n, 2, lanes), F32), np.empty(2 * lanes, F32)
    memory, longer_memory = np.empty((n_pairs, 2, lanes), F32), np.empty((n_longer, 2, lanes), F32)
    unit_short = np.zeros((n, lanes), F32)
    falsehood = np.empty((longer_variables.shape[1], lanes), F32)
    # Arrays of their own: rows of one array could overlap for all that the compiler knows.
    smallest, next_smallest, at = np.empty(lanes, F32), np.empty(lanes, F32), np.empty(lanes, F32)
    scratch = (push, falsehood, (smallest, next_smallest, at, np.empty(lanes, F32), np.empty(lanes, F32)))
    memories = (memory, unit_short, unit_long, longer_memory)
    for e in range(n_pairs):
        for k in range(lanes):
            memory[e, 1, k] = long[e, k]
    for e in range(n_longer):
        for k in range(lanes):
            longer_memory[e, 1, k] = longer_long[e, k]
    start(kind, problem, memories, voltage, c)
    x, field, true = np.empty((lanes, n), F32), np.empty((lanes, n), F32), np.zeros((lanes, n_longer), np.int32)
    tried, tried_field, tried_true = np.empty(n, F32), np.empty(n, F32), np.empty(n_longer, np.int32)
    signs, found = np.empty((lanes, n), F32), np.empty(n + 1, np.uint64)
    energy, changed = np.zeros(lanes), np.full(lanes, True)
    lowest, found_at = np.full(lanes, 1e300), np.zeros(lanes, np.int64)
    elapsed, dt, size = np.zeros(lanes), np.zeros(lanes, F32), np.empty(lanes, F32)
    before = np.zeros((n, lanes), F32)
    transpose_signs(voltage, x)
    for k in range(lanes):
        energy[k] = local_fields_listed(digital, linear, pairs, x[k], field[k], true[k])
    last, n_running = np.full(lanes, n_steps), lanes
    n_reads, counter = 0, U64(0)
    for step in range(n_steps + 1):
        recorded = every > 0 and step > 0 and step % every == 0
        reads = quench_every == 0 or step % quench_every == 0
        if step > 0 and (reads or recorded):
            transpose_signs(voltage, signs)
            n_reads += 1
            for k in range(lanes):
                change, n_changed = read_out_listed(digital, signs[k], x[k], field[k], true[k], found)
                energy[k] += change
                changed[k] = changed[k] or n_changed > 0
                if n_reads % REFRESH == 0:
                    energy[k] = local_fields_listed(digital, linear, pairs, x[k], field[k], true[k])
        if reads:
            for k in range(lanes):
                if not changed[k]:
                    continue
                lowest[k], found_at[k] = keep_better(energy[k], lowest[k], x[k], best[k], step, found_at[k])
                if quench_every > 0:
                    copy(x[k], tried)
                    copy(field[k], tried_field)
                    copy(true[k], tried_true)
                    reached = energy[k] + quench_listed(digital, tried, tried_field, tried_true)
                    lowest[k], found_at[k] = keep_better(reached, lowest[k], tried, best[k], step, found_at[k])
                changed[k] = False
        if recorded:
            for k in range(lanes):
                times[k, step // every - 1] = elapsed[k]
                for i in range(n):
                    states[k, step // every - 1, i] = x[k, i] > half
        # One pass moves the memories by the step that led here and finds the rate of the voltages.
        rate[:] = 0
        advance(kind, problem, memories, voltage, rate, scratch, c, dt)
        if reads:
            for k in range(lanes):
                if last[k] == n_steps and step < n_steps and step >= min_steps + stall * found_at[k]:
                    last[k] = step
                    n_running -= 1
        if step == n_steps or stop[0] != 0 or n_running == 0:
            break
        lag = control[LAG] if step > 0 else F32(0)
        size[:] = 0
        for i in range(n):
            for k in range(lanes):
                now = rate[i, 0, k]
                rate[i, 0, k] += lag * (before[i, k] - now)
                before[i, k] = now
            for k in range(lanes):
                size[k] += rate[i, 0, k] * rate[i, 0, k]
        for k in range(lanes):
            # A step of size 0 leaves voltages and memories where they are.
            change = control[CHANGE] / max(F32(math.sqrt(size[k] / F32(n))), TINY)
            dt[k] = min(control[DT_MAX], max(control[DT_MIN], change)) if last[k] == n_steps else F32(0)
            elapsed[k] += dt[k]
        for i in range(n):
            for k in range(lanes):
                voltage[i, k] += dt[k] * rate[i, 0, k]
        if control[NOISE] > 0:
            for i in range(n):
                for k in range(lanes):
                    voltage[i, k] += control[NOISE] * math.sqrt(dt[k]) * uniform(seeds[k], counter + U64(i))
            counter += U64(n)
        for i in range(n):
            for k in range(lanes):
                voltage[i, k] = min(one, max(-one, voltage[i, k]))
    for e in range(n_pairs):
        for k in range(lanes):
            long[e, k] = memory[e, 1, k]
    for e in range(n_longer):
        for k in range(lanes):
            longer_long[e, k] = longer_memory[e, 1, k]
    return found_at, last
