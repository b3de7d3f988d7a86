"""Kernel for CUDA devices: one block of threads integrates one restart.

The threads of a block share the pairs, then the variables. A pair's memories move once and leave its pushes in an
array; each variable then adds up those of its own pairs, in their order. So no two threads write to one number,
and every run gives the same bits. What goes along the variables one by one, reading the bits and descending from
them, all threads decide alike; the fields of a flip's neighbours they share.

All arrays are float32 in the device's memory, a row a problem or a restart. The equations are the CPU kernels' own
functions of ``common``, and the order of steps, readings and flips is that of ``lanes``.
"""

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numba import cuda

from memcomp_lightning.solvers.dmm.bond import BondField
from memcomp_lightning.solvers.dmm.clause import ClauseField
from memcomp_lightning.solvers.dmm.kernels import common
from memcomp_lightning.solvers.dmm.kernels.common import (
    CHANGE,
    DT_MAX,
    DT_MIN,
    EPSILON,
    F32,
    LAG,
    NOISE,
    SHORT_TERM_START,
    TINY,
)
from memcomp_lightning.solvers.dmm.kernels.digital import MAX_SWEEPS, REFRESH

U64 = np.uint64

MOST_THREADS = 512
"""Of a block: each then has 128 registers."""


def on_device(function):
    """Make a function for CUDA kernels of a plain one, or of one that is compiled for the CPU."""
    return cuda.jit(device=True)(getattr(function, "py_func", function))


clause, clause_rates, unit_clause, unit_rates, bond, bond_rates, bond_field, field_rates, uniform = (
    on_device(getattr(common, name))
    for name in (
        *("clause", "clause_rates", "unit_clause", "unit_rates"),
        *("bond", "bond_rates", "bond_field", "field_rates", "uniform"),
    )
)


# ------------------------------------------------------------------------------------------- what a field does


class Passes(NamedTuple):
    """What the kernel needs of a field, as functions for the device.

    Attributes:
        start: ``start(first, second, polarity, other_polarity, c)`` is the short-term memory of a pair at the
            voltages of its ends.
        move: ``move(first, second, weight, polarity, other_polarity, short, long, c, dt)`` is both memories of a
            pair, moved by ``dt``, and its push on each end.
        rate: ``rate(unit, voltage, short, long, push, pull, c, dt)`` is both memories of a unit, moved, and the
            rate of its variable's voltage; ``push`` and ``pull`` are the sums over the pairs.
        pulls: Whether pairs pull: by the size of the weight times the short-term memory.
    """

    start: object
    move: object
    rate: object
    pulls: bool


@on_device
def clause_start(first, second, polarity, other, c):
    """x_s(0) + epsilon = C(0) + epsilon."""
    half = F32(0.5)
    return c[EPSILON] + min(half - half * polarity * first, half - half * other * second)


@on_device
def clause_move(first, second, weight, polarity, other, short, long, c, dt):
    """See :class:`Passes`; the memories are those of ``common.clause``."""
    half = F32(0.5)
    false_first, false_second = half - half * polarity * first, half - half * other * second
    short, long, at_first, at_second = clause(false_first, false_second, short, long, clause_rates(c, dt))
    return short, long, weight * polarity * at_first, weight * other * at_second


@on_device
def clause_rate(unit, voltage, short, long, push, pull, c, dt):
    """See :class:`Passes`; unit clauses have no short-term memory."""
    long, own = unit_clause(unit, voltage, long, unit_rates(c), dt)
    return short, long, push + own


@on_device
def bond_start(first, second, polarity, other, c):
    """X(0)."""
    return c[SHORT_TERM_START]


@on_device
def bond_move(first, second, weight, polarity, other, short, long, c, dt):
    """See :class:`Passes`; the memories are those of ``common.bond``."""
    zero, one = F32(0), F32(1)
    sign = one if weight > zero else (-one if weight < zero else zero)
    short, long = bond(sign * first, second, short, long, bond_rates(c), dt)
    return short, long, weight * second, weight * first


@on_device
def bond_rate(unit, voltage, short, long, push, pull, c, dt):
    """See :class:`Passes`."""
    return bond_field(unit, voltage, short, long, push, pull, field_rates(c), dt)


PASSES = {
    ClauseField: Passes(clause_start, clause_move, clause_rate, False),
    BondField: Passes(bond_start, bond_move, bond_rate, True),
}
"""By the class of the field."""


# -------------------------------------------------------------------------------------------- what a block does


@on_device
def add_up(sums, value):
    """The sum of the threads' values, the same in all of them."""
    thread, half = cuda.threadIdx.x, cuda.blockDim.x // 2
    cuda.syncthreads()  # the last sum has been read
    sums[thread] = value
    cuda.syncthreads()
    while half > 0:
        if thread < half:
            sums[thread] += sums[thread + half]
        cuda.syncthreads()
        half //= 2
    return sums[0]


@on_device
def local_fields(begins, neighbour, coupling, linear, x, field, sums):
    """Write the local fields of a digital state from scratch; return its energy."""
    energy = 0.0
    for i in range(cuda.threadIdx.x, linear.shape[0], cuda.blockDim.x):
        total = linear[i]
        for at in range(begins[i], begins[i + 1]):
            total += coupling[at] * x[neighbour[at]]
        field[i] = total
        energy += F32(0.5) * x[i] * (linear[i] + total)
    return add_up(sums, energy)


@on_device
def flip(begins, neighbour, coupling, x, field, i, change):
    """Change one variable and the fields of its neighbours."""
    cuda.syncthreads()  # all threads have read what made them flip it
    for at in range(begins[i] + cuda.threadIdx.x, begins[i + 1], cuda.blockDim.x):
        field[neighbour[at]] += coupling[at] * change
    if cuda.threadIdx.x == 0:
        x[i] += change
    cuda.syncthreads()


@on_device
def read_out(begins, neighbour, coupling, voltage, x, field, energy):
    """Bring the digital state up to the voltages; return its energy, and whether any bit changed."""
    changed = False
    for i in range(x.shape[0]):
        change = (F32(1) if voltage[i] > F32(0) else F32(0)) - x[i]
        if change != F32(0):
            changed = True
            energy += change * field[i]
            flip(begins, neighbour, coupling, x, field, i, change)
    return energy, changed


@on_device
def quench(begins, neighbour, coupling, x, field, energy):
    """Flip single variables as long as each flip lowers the energy; return it."""
    for _ in range(MAX_SWEEPS):
        n_flips = 0
        for i in range(x.shape[0]):
            change = F32(1) - F32(2) * x[i]
            if change * field[i] < F32(0):
                n_flips += 1
                energy += change * field[i]
                flip(begins, neighbour, coupling, x, field, i, change)
        if n_flips == 0:
            break
    return energy


@on_device
def keep_better(energy, lowest, x, best, step, found_at):
    """Copy a state to ``best`` if its energy is lower; return the lowest energy, and the step that found it."""
    if energy < lowest:
        lowest, new = energy, 0
        for i in range(cuda.threadIdx.x, x.shape[0], cuda.blockDim.x):
            if best[i] != x[i]:
                new = 1
            best[i] = x[i]
        if cuda.syncthreads_or(new) or step == 0:
            found_at = step
    return lowest, found_at


@cache
def compiled(field: type):
    """The kernel for a class of fields."""
    start, move, rate_of, pulls = PASSES[field]

    @cuda.jit
    def integrate(
        pairs,
        weight,
        polarity,
        unit,
        begins,
        ends,
        neighbour,
        coupling,
        linear,
        constants,
        control,
        seed,
        n_steps,
        quench_every,
        every,
        min_steps,
        stall,
        fresh,
        voltage,
        short,
        long,
        unit_short,
        unit_long,
        push,
        work,
        best,
        found_at,
        last,
        times,
        states,
    ):
        """Integrate one restart; the number of the block is that of the restart, problem by problem.

        Args:
            pairs: The variables of each pair, ``(n_pairs, 2)``.
            weight: Of the pairs, ``(n_problems, n_pairs)``.
            polarity: ``(n_problems, n_pairs, 2)``.
            unit: Unit clauses or fields, ``(n_problems, n)``.
            begins: Where the ends of each variable begin in the next three, ``(n + 1,)``.
            ends: Number of a pair, or behind n_pairs that of a pair whose second end it is.
            neighbour: The variable at the other end.
            coupling: Of the energy, ``(n_problems, 2 n_pairs)``.
            linear: Of the energy, ``(n_problems, n)``.
            constants: Of the field, named in ``common.CONSTANTS``, a row a problem.
            control: Step control, named in ``common.CONTROL``, a row a problem.
            seed: Of the noise, ``(n_problems, n_restarts)``.
            n_steps: Steps.
            quench_every: 0 reads each step without a quench.
            every: Steps between records; 0 records nothing.
            min_steps: See ``stall``.
            stall: The restart ends at a reading from step min_steps + stall found_at on.
            fresh: Whether long-term memories begin at rest; otherwise they are given.
            voltage: ``(n_problems, n_restarts, n)``, initial values in, final values out, as all below.
            short: Scratch, ``(..., n_pairs)``.
            long: Long-term memories less 1, in and out.
            unit_short: Scratch, ``(..., n)``.
            unit_long: Long-term memories of units less 1, in and out.
            push: Scratch, ``(..., 2 n_pairs)``.
            work: Scratch, ``(..., 6, n)``.
            best: Out, the assignment of lowest energy, ``(..., n)``.
            found_at: Out, the step at which it was met.
            last: Out, the number of steps done.
            times: Out, ``(..., n_records)``.
            states: Out, ``(..., n_records, n)``.
        """
        sums = cuda.shared.array(MOST_THREADS, np.float64)
        thread, width = cuda.threadIdx.x, cuda.blockDim.x
        p, r = cuda.blockIdx.x // seed.shape[1], cuda.blockIdx.x % seed.shape[1]
        weight, polarity, unit, coupling, linear = weight[p], polarity[p], unit[p], coupling[p], linear[p]
        c, control, seed = constants[p], control[p], seed[p, r]
        voltage, short, long, push, best = voltage[p, r], short[p, r], long[p, r], push[p, r], best[p, r]
        unit_short, unit_long, times, states = unit_short[p, r], unit_long[p, r], times[p, r], states[p, r]
        rate, before, x, field, tried, tried_field = (
            work[p, r, 0],
            work[p, r, 1],
            work[p, r, 2],
            work[p, r, 3],
            work[p, r, 4],
            work[p, r, 5],
        )
        zero, one = F32(0), F32(1)
        n, n_pairs = unit.shape[0], weight.shape[0]
        for i in range(thread, n, width):
            x[i] = one if voltage[i] > zero else zero
            before[i], unit_short[i] = zero, c[SHORT_TERM_START]
            if fresh:
                unit_long[i] = zero
        for e in range(thread, n_pairs, width):
            first, second = voltage[pairs[e, 0]], voltage[pairs[e, 1]]
            short[e] = start(first, second, polarity[e, 0], polarity[e, 1], c)
            if fresh:
                long[e] = zero
        cuda.syncthreads()
        energy, lowest, elapsed, met_at, done = 0.0, 1e300, 0.0, 0, n_steps
        dt, changed, n_looks, counter = F32(0), True, 0, U64(0)
        for step in range(n_steps + 1):
            recorded = every > 0 and step > 0 and step % every == 0
            reads = quench_every == 0 or step % quench_every == 0
            if reads or recorded:
                n_looks += 1
                if step > 0:
                    energy, differs = read_out(begins, neighbour, coupling, voltage, x, field, energy)
                    changed = changed or differs
                if step == 0 or n_looks % REFRESH == 0:
                    energy = local_fields(begins, neighbour, coupling, linear, x, field, sums)
            if reads and changed:
                lowest, met_at = keep_better(energy, lowest, x, best, step, met_at)
                if quench_every > 0:
                    for i in range(thread, n, width):
                        tried[i], tried_field[i] = x[i], field[i]
                    cuda.syncthreads()
                    reached = quench(begins, neighbour, coupling, tried, tried_field, energy)
                    lowest, met_at = keep_better(reached, lowest, tried, best, step, met_at)
                changed = False
            if recorded:
                times[step // every - 1] = elapsed
                for i in range(thread, n, width):
                    states[step // every - 1, i] = x[i] > F32(0.5)
            # One pass moves the memories by the step that led here and finds the rate of the voltages.
            for e in range(thread, n_pairs, width):
                first, second = voltage[pairs[e, 0]], voltage[pairs[e, 1]]
                short[e], long[e], push[e], push[n_pairs + e] = move(
                    first, second, weight[e], polarity[e, 0], polarity[e, 1], short[e], long[e], c, dt
                )
            cuda.syncthreads()
            for i in range(thread, n, width):
                total, pull = zero, zero
                for at in range(begins[i], begins[i + 1]):
                    total += push[ends[at]]
                    if pulls:
                        e = ends[at] if ends[at] < n_pairs else ends[at] - n_pairs
                        pull += abs(weight[e]) * short[e]
                unit_short[i], unit_long[i], rate[i] = rate_of(
                    unit[i], voltage[i], unit_short[i], unit_long[i], total, pull, c, dt
                )
            if step == n_steps or (reads and step >= min_steps + stall * met_at):
                done = step
                break
            lag, size = control[LAG] if step > 0 else zero, 0.0
            for i in range(thread, n, width):
                now = rate[i]
                mixed = now + lag * (before[i] - now)
                before[i], rate[i] = now, mixed
                size += mixed * mixed
            size = F32(math.sqrt(add_up(sums, size) / n))
            dt = min(control[DT_MAX], max(control[DT_MIN], control[CHANGE] / max(size, TINY)))
            kick = control[NOISE] * F32(math.sqrt(dt))
            for i in range(thread, n, width):
                moved = voltage[i] + dt * rate[i]
                if kick > zero:
                    moved += kick * uniform(seed, counter + U64(i))
                voltage[i] = min(one, max(-one, moved))
            counter += U64(n)
            elapsed += dt
            cuda.syncthreads()
        if thread == 0:
            found_at[p, r], last[p, r] = met_at, done

    return integrate
