"""Compiled kernel for listed pairs and longer clauses: vectors run along the restarts.

One call integrates a block of 4, 8 or 16 restarts, its lanes, side by side: every number of a variable or a clause
is a row, one number a lane. Time and memory are linear in the number of pairs. All arrays are float32 with the
lanes last; each lane has a step size of its own. The equations are those of ``ClauseField`` and ``BondField``, the
scheme is ``Splitting``.

A pass takes the pairs in chunks of ``ROWS``: it gathers the rows of their variables, moves the memories in one
long loop over flat arrays, and adds the pushes to the rows of the variables. Only such loops become vector code:
in one over a single pair the compiler would have to make sure that no two rows overlap, pair by pair.
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
    LAG,
    LONG_TERM_MAX,
    NOISE,
    SHORT_TERM_START,
    TINY,
    bond,
    bond_field,
    bond_rates,
    clause,
    clause_rates,
    field_rates,
    inlined,
    uniform,
    unit_clause,
    unit_rates,
)
from memcomp_lightning.solvers.dmm.kernels.digital import (
    REFRESH,
    add,
    copy,
    keep_better_listed,
    local_fields_listed,
    quench_listed,
    read_out_listed,
)

if TYPE_CHECKING:
    from memcomp_lightning.solvers.dmm.kernels.fields import Compiled

U64 = np.uint64

ROWS = 64
"""Pairs or variables in a chunk: enough to hide the cost of a loop, few enough to stay close to the processor."""


@inlined
def gather(lanes, row, to, offset, factor, voltage, at):
    """Write ``offset`` plus ``factor`` times a row of voltages."""
    if lanes == U64(4):  # as in ``add``
        one, two, three = U64(1), U64(2), U64(3)
        first, second = offset + factor * voltage[at], offset + factor * voltage[at + one]
        third, fourth = offset + factor * voltage[at + two], offset + factor * voltage[at + three]
        row[to], row[to + one], row[to + two], row[to + three] = first, second, third, fourth
    else:
        for k in range(lanes):
            row[to + k] = offset + factor * voltage[at + k]


@inlined
def clause_pass(lanes, pairs, weight, polarity, short, long, voltage, rate, buffers, c):
    """Advance the memories of all pairs at the present voltages, then add the pairs' drive to ``rate``."""
    dt, first, second = buffers
    half, zero = F32(0.5), U64(0)
    for begin in range(zero, U64(weight.size), U64(ROWS)):
        end, to, at = min(begin + U64(ROWS), U64(weight.size)), zero, begin * lanes
        for e in range(begin, end):
            gather(lanes, first, to, half, -half * polarity[e, 0], voltage, U64(pairs[e, 0]) * lanes)
            gather(lanes, second, to, half, -half * polarity[e, 1], voltage, U64(pairs[e, 1]) * lanes)
            to += lanes
        for x in range(to):
            short[at + x], long[at + x], first[x], second[x] = clause(
                first[x], second[x], short[at + x], long[at + x], clause_rates(c, dt[x])
            )
        to = zero
        for e in range(begin, end):
            add(lanes, rate, U64(pairs[e, 0]) * lanes, weight[e] * polarity[e, 0], first, to)
            add(lanes, rate, U64(pairs[e, 1]) * lanes, weight[e] * polarity[e, 1], second, to)
            to += lanes


@inlined
def bond_pass(lanes, pairs, weight, short, long, voltage, drive, pull, buffers, c):
    """Advance the memories of all bonds at the present voltages, then add their drive and pull."""
    dt, first, second = buffers
    none, zero, one, rates = U64(0), F32(0), F32(1), bond_rates(c)
    for begin in range(none, U64(weight.size), U64(ROWS)):
        end, to, at = min(begin + U64(ROWS), U64(weight.size)), none, begin * lanes
        for e in range(begin, end):
            sign = one if weight[e] > zero else (-one if weight[e] < zero else zero)
            gather(lanes, first, to, zero, sign, voltage, U64(pairs[e, 0]) * lanes)
            gather(lanes, second, to, zero, one, voltage, U64(pairs[e, 1]) * lanes)
            to += lanes
        for x in range(to):
            short[at + x], long[at + x] = bond(first[x], second[x], short[at + x], long[at + x], rates, dt[x])
        to = none
        for e in range(begin, end):
            a, b, size = U64(pairs[e, 0]) * lanes, U64(pairs[e, 1]) * lanes, abs(weight[e])
            add(lanes, drive, a, weight[e], second, to)
            add(lanes, drive, b, size, first, to)
            add(lanes, pull, a, size, short, at + to)
            add(lanes, pull, b, size, short, at + to)
            to += lanes


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
        w, short = weight[e], U64(e) * lanes
        long = U64(weight.size) * lanes + short
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
                a, number = U64(variables[e, i]) * lanes, F32(i)
                for k in range(lanes):
                    at_first = gradient[k] * next_smallest[k] + rigidity[k]
                    r[a + k] += q * (at_first if at[k] == number else gradient[k] * smallest[k])


@inlined
def spread_out(lanes, values, begin, row):
    """Write a chunk of numbers, one a variable, once for each lane; return how many."""
    to = U64(0)
    for i in range(begin, min(begin + U64(ROWS), U64(values.size))):
        for k in range(lanes):
            row[to + k] = values[i]
        to += lanes
    return to


@inlined
def clause_units(lanes, unit, long, voltage, rate, buffers, c):
    """Advance the memories of the unit clauses and add their pull."""
    dt, own, _ = buffers
    rates = unit_rates(c)
    for begin in range(U64(0), U64(unit.size), U64(ROWS)):
        size, at = spread_out(lanes, unit, begin, own), begin * lanes
        for x in range(size):
            long[at + x], pull = unit_clause(own[x], voltage[at + x], long[at + x], rates, dt[x])
            rate[at + x] += pull


@inlined
def bond_fields(lanes, field, short, long, voltage, drive, pull, buffers, c):
    """Advance the memories of the fields, then turn drive and pull into the rate of the voltages."""
    dt, own, _ = buffers
    rates = field_rates(c)
    for begin in range(U64(0), U64(field.size), U64(ROWS)):
        size, at = spread_out(lanes, field, begin, own), begin * lanes
        for x in range(size):
            v, before, y = voltage[at + x], short[at + x], long[at + x]
            short[at + x], long[at + x], drive[at + x] = bond_field(
                own[x], v, before, y, drive[at + x], pull[at + x], rates, dt[x]
            )
            pull[at + x] = F32(0)


@inlined
def clause_start(problem, memories, voltage, c):
    """Short-term memories begin at x_s(0) = C(0): how far each clause is from being satisfied."""
    _, pairs, _, polarity, _, (variables, longer_polarity, _) = problem
    memory, _, _, longer_memory = memories
    half, one = F32(0.5), F32(1)
    for e in range(memory.shape[1]):
        for k in range(voltage.shape[1]):
            false_first = half - half * polarity[e, 0] * voltage[pairs[e, 0], k]
            false_second = half - half * polarity[e, 1] * voltage[pairs[e, 1], k]
            memory[0, e, k] = c[EPSILON] + min(false_first, false_second)
    for e in range(longer_memory.shape[1]):
        for k in range(voltage.shape[1]):
            unsatisfied = one
            for j in range(variables.shape[1]):
                sign = longer_polarity[e, j]
                if sign != 0:
                    unsatisfied = min(unsatisfied, half - half * sign * voltage[variables[e, j], k])
            longer_memory[0, e, k] = c[EPSILON] + unsatisfied


@njit(nogil=True, cache=True, forceinline=True)
def clause_advance(problem, memories, voltage, rate, scratch, c, dt):
    """Clauses of two literals, of one, and of more."""
    _, pairs, weight, polarity, unit, longer = problem
    memory, _, unit_long, longer_memory = memories
    buffers, falsehood, numbers = scratch
    v, r, unit_long = voltage.ravel(), rate[0].ravel(), unit_long.ravel()
    of_pairs = (pairs, weight, polarity, memory[0].ravel(), memory[1].ravel())
    # Numbers that the compiler knows make short loops over the lanes single instructions.
    if dt.size == 4:
        clause_pass(U64(4), *of_pairs, v, r, buffers, c)
        clause_units(U64(4), unit, unit_long, v, r, buffers, c)
    elif dt.size == 8:
        clause_pass(U64(8), *of_pairs, v, r, buffers, c)
        clause_units(U64(8), unit, unit_long, v, r, buffers, c)
    else:
        clause_pass(U64(16), *of_pairs, v, r, buffers, c)
        clause_units(U64(16), unit, unit_long, v, r, buffers, c)
    longer_pass(longer, longer_memory, voltage, r, falsehood, numbers, c, dt)


@inlined
def bond_start(problem, memories, voltage, c):
    """All short-term memories begin at ``short_term_start``."""
    memory, unit_short, _, _ = memories
    for e in range(memory.shape[1]):
        for k in range(voltage.shape[1]):
            memory[0, e, k] = c[SHORT_TERM_START]
    unit_short[:] = c[SHORT_TERM_START]


@njit(nogil=True, cache=True, forceinline=True)
def bond_advance(problem, memories, voltage, rate, scratch, c, dt):
    """Bonds, then fields."""
    _, pairs, bond, _, field, _ = problem
    memory, field_short, field_long, _ = memories
    buffers, _, _ = scratch
    v, drive, pull = voltage.ravel(), rate[0].ravel(), rate[1].ravel()
    of_pairs = (pairs, bond, memory[0].ravel(), memory[1].ravel())
    of_fields = (field, field_short.ravel(), field_long.ravel())
    if dt.size == 4:
        bond_pass(U64(4), *of_pairs, v, drive, pull, buffers, c)
        bond_fields(U64(4), *of_fields, v, drive, pull, buffers, c)
    elif dt.size == 8:
        bond_pass(U64(8), *of_pairs, v, drive, pull, buffers, c)
        bond_fields(U64(8), *of_fields, v, drive, pull, buffers, c)
    else:
        bond_pass(U64(16), *of_pairs, v, drive, pull, buffers, c)
        bond_fields(U64(16), *of_fields, v, drive, pull, buffers, c)


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


@inlined
def mix(rate, before, lag, squares, begin, size):
    """Mix the rates of a chunk with those of the last step, and add their squares to those of other chunks."""
    for x in range(size):
        now = rate[begin + x]
        mixed = now + lag * (before[begin + x] - now)
        before[begin + x] = now
        rate[begin + x] = mixed
        squares[x] += mixed * mixed


@inlined
def move(voltage, rate, dt, begin, size):
    """Move the voltages of a chunk, and set their rates to zero."""
    for x in range(size):
        voltage[begin + x] += dt[x] * rate[begin + x]
        rate[begin + x] = F32(0)


@inlined
def look(lanes, digital, linear, voltage, states, quenches, n_looks, step):
    """Read the bits of all lanes; compare with the best ones, and quench a copy, where they have changed.

    ``quenches`` is -1 where the bits are only brought up to the voltages, 0 for no quench, 1 for one.
    """
    state, tried, energy, reached, lowest, found_at, changed, best, rows = states
    change, better = rows
    if step > 0:
        read_out_listed(lanes, digital, voltage, *state, energy, changed, change)
        if n_looks % REFRESH == 0:
            local_fields_listed(lanes, digital, linear, *state, energy)
    else:
        local_fields_listed(lanes, digital, linear, *state, energy)
    some = F32(0)
    for k in range(lanes):
        some += changed[k]
    if quenches < 0 or some == F32(0):
        return
    keep_better_listed(lanes, energy, lowest, state[0], best, step, found_at, better, change)
    if quenches > 0:
        copy(state[0], tried[0])
        copy(state[1], tried[1])
        copy(state[2], tried[2])
        copy(energy, reached)
        quench_listed(lanes, digital, *tried, reached, changed, change)
        keep_better_listed(lanes, reached, lowest, tried[0], best, step, found_at, better, change)
    for k in range(lanes):
        changed[k] = F32(0)


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
        start: (voltage, memory, unit_long, longer_memory), each ``(n_problems, n_blocks, ..., lanes)``, and the
            seeds.
        steps: (n_steps, quench_every, record_every, min_steps, stall), see :func:`integrate`.
        best: Out, ``(n_problems, n_blocks, n, lanes)``.
        found_at: Out, the step at which it was met, ``(n_problems, n_blocks, lanes)``; 0 for the initial state.
        last: Out, the number of steps done, likewise.
        times: Out, ``(n_problems, n_blocks, lanes, n_records)``.
        states: Out, ``(n_problems, n_blocks, lanes, n_records, n)``.
    """
    kind, constants, pairs, weight, polarity, unit, longer, digital, linear = problem
    variables, longer_polarity, longer_weight = longer
    offsets, neighbour, coupling, in_clause, clause_of, clause_weight = digital
    voltage, memory, unit_long, longer_memory, seed = start
    n_blocks = voltage.shape[1]
    for item in range(begin, end):
        if stop[0] != 0:
            return
        p, b = item // n_blocks, item % n_blocks
        of_clauses = (in_clause, clause_of, variables, longer_polarity, clause_weight[p])
        integrate(
            (kind, pairs, weight[p], polarity[p], unit[p], (variables, longer_polarity, longer_weight[p])),
            (offsets, neighbour, coupling[p], *of_clauses),
            linear[p],
            constants[p],
            control[p],
            voltage[p, b],
            (memory[p, b], unit_long[p, b], longer_memory[p, b]),
            seed[p, b],
            steps,
            stop,
            best[p, b].ravel(),
            found_at[p, b],
            last[p, b],
            times[p, b],
            states[p, b],
        )


# Not kept on disk by itself: with passes of another package it would be, once more in each process.
@njit(nogil=True, fastmath=FAST_MATH, forceinline=True)
def integrate(
    problem,
    digital,
    linear,
    c,
    control,
    voltage,
    memories,
    seeds,
    steps,
    stop,
    best,
    found_at,
    last,
    times,
    states,
):
    """Integrate the lanes of a block.

    Args:
        problem: (kind, pairs, weight or bond, polarity, unit or field, the longer clauses: variables, polarity
            and weight).
        digital: What ``flip_listed`` needs.
        linear: ``(n,)``, of the energy.
        c: Constants of the field, named in ``common.CONSTANTS``.
        control: Step control, named in ``common.CONTROL``.
        voltage: ``(n, lanes)``, initial values in and final values out.
        memories: Of pairs, ``(2, n_pairs, lanes)``, long-term ones of units, ``(n, lanes)``, and of longer
            clauses; the long-term ones, less 1, are initial values in, all are final values out.
        seeds: Of the noise.
        steps: (n_steps, quench_every, record_every, min_steps, stall); quench_every = 0 reads each step without a
            quench. A restart rests from the first reading at or after step min_steps + stall found_at.
        stop: One number; anything but 0 ends the integration.
        best: ``(n lanes,)``, out: the assignments of lowest energy.
        found_at: ``(lanes,)``, out: the step at which each one was met.
        last: ``(lanes,)``, out: the last step of each lane.
        times: ``(lanes, n_records)``, out.
        states: ``(lanes, n_records, n)``, out.
    """
    kind, _, _, _, unit, longer = problem
    variables, _, longer_weight = longer
    n_steps, quench_every, every, min_steps, stall = steps
    half, zero, one = F32(0.5), F32(0), F32(1)
    n, n_longer, lanes = unit.size, longer_weight.size, voltage.shape[1]
    memory, unit_long, longer_memory = memories
    rate, unit_short = np.zeros((2, n, lanes), F32), np.zeros((n, lanes), F32)
    memories = (memory, unit_short, unit_long, longer_memory)
    start(kind, problem, memories, voltage, c)
    # Step sizes of the lanes once for each row of a chunk, and two chunks of intermediate results.
    dts, first, second = np.zeros(ROWS * lanes, F32), np.empty(ROWS * lanes, F32), np.empty(ROWS * lanes, F32)
    # Arrays of their own: rows of one array could overlap for all that the compiler knows.
    smallest, next_smallest, at = np.empty(lanes, F32), np.empty(lanes, F32), np.empty(lanes, F32)
    numbers = (smallest, next_smallest, at, np.empty(lanes, F32), np.empty(lanes, F32))
    scratch = ((dts, first, second), np.empty((variables.shape[1], lanes), F32), numbers)
    v, r, before = voltage.ravel(), rate[0].ravel(), np.zeros(n * lanes, F32)
    chunk = U64(dts.size)
    rest = U64(r.size) % chunk
    whole = U64(r.size) - rest
    x = np.zeros(n * lanes, F32)
    for i in range(x.size):
        x[i] = one if v[i] > zero else zero
    state = (x, np.empty(n * lanes, F32), np.empty(n_longer * lanes, F32))
    tried = (np.empty(n * lanes, F32), np.empty(n * lanes, F32), np.empty(n_longer * lanes, F32))
    energy, reached, lowest = np.zeros(lanes), np.zeros(lanes), np.full(lanes, 1e300)
    rows = (np.empty(lanes, F32), np.empty(lanes, F32))
    seen = (state, tried, energy, reached, lowest, found_at, np.ones(lanes, F32), best, rows)
    elapsed, dt = np.zeros(lanes), np.zeros(lanes, F32)
    for k in range(lanes):
        found_at[k], last[k] = 0, n_steps
    n_running, n_looks, counter = lanes, 0, U64(0)
    for step in range(n_steps + 1):
        recorded = every > 0 and step > 0 and step % every == 0
        reads = quench_every == 0 or step % quench_every == 0
        if reads or recorded:
            quenches = (1 if quench_every > 0 else 0) if reads else -1
            n_looks += 1
            if lanes == 4:
                look(U64(4), digital, linear, v, seen, quenches, n_looks, step)
            elif lanes == 8:
                look(U64(8), digital, linear, v, seen, quenches, n_looks, step)
            else:
                look(U64(16), digital, linear, v, seen, quenches, n_looks, step)
        if recorded:
            for k in range(lanes):
                times[k, step // every - 1] = elapsed[k]
                for i in range(n):
                    states[k, step // every - 1, i] = x[i * lanes + k] > half
        # One pass moves the memories by the step that led here and finds the rate of the voltages.
        advance(kind, problem, memories, voltage, rate, scratch, c, dt)
        if reads:
            for k in range(lanes):
                if last[k] == n_steps and step < n_steps and step >= min_steps + stall * found_at[k]:
                    last[k] = step
                    n_running -= 1
        if step == n_steps or stop[0] != 0 or n_running == 0:
            break
        lag = control[LAG] if step > 0 else zero
        for y in range(first.size):
            first[y] = zero
        for at_chunk in range(U64(0), whole, chunk):
            mix(r, before, lag, first, at_chunk, chunk)
        mix(r, before, lag, first, whole, rest)
        for k in range(lanes):
            size = zero
            for row in range(ROWS):
                size += first[row * lanes + k]
            # A step of size 0 leaves voltages and memories where they are.
            change = control[CHANGE] / max(F32(math.sqrt(size / F32(n))), TINY)
            dt[k] = min(control[DT_MAX], max(control[DT_MIN], change)) if last[k] == n_steps else zero
            elapsed[k] += dt[k]
            for row in range(ROWS):
                dts[row * lanes + k] = dt[k]
        for at_chunk in range(U64(0), whole, chunk):
            move(v, r, dts, at_chunk, chunk)
        move(v, r, dts, whole, rest)
        if control[NOISE] > 0:
            for i in range(n):
                for k in range(lanes):
                    voltage[i, k] += control[NOISE] * math.sqrt(dt[k]) * uniform(seeds[k], counter + U64(i))
            counter += U64(n)
        for i in range(v.size):
            v[i] = min(one, max(-one, v[i]))
