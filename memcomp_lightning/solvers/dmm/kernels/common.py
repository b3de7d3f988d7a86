"""What the compiled kernels share: constants, step size, noise, the motion of the voltages."""

from typing import Final

import numpy as np
from numba import njit

F32: Final = np.float32

BOND: Final = 1
"""Kind of field: bond dynamics; clause dynamics is 0."""

ALPHA: Final = 0
BETA: Final = 1
GAMMA: Final = 2
DELTA: Final = 3
ZETA: Final = 4
EPSILON: Final = 5
KAPPA: Final = 6
LONG_TERM_MAX: Final = 7
UNIT_PULL: Final = 8
SHORT_TERM_MIN: Final = 9
SHORT_TERM_START: Final = 10
PULL_SCALE: Final = 11
CONSTANTS: Final = (
    *("alpha", "beta", "gamma", "delta", "zeta", "epsilon", "kappa", "long_term_max", "unit_pull"),
    *("short_term_min", "short_term_start", "pull_scale"),
)
"""What stands in a problem's row of constants, by the names of the fields' settings; 0 where a field has none."""

CHANGE: Final = 0
DT_MIN: Final = 1
DT_MAX: Final = 2
NOISE: Final = 3
LAG: Final = 4
CONTROL: Final = ("change", "dt_min", "dt_max", "noise", "lag")
"""What stands in a problem's row of step control."""

TINY: Final = np.float32(1e-30)
"""In place of a rate of 0, which asks for the longest step."""

FAST_MATH: Final = {"reassoc", "contract", "nsz", "arcp", "nnan", "ninf"}
"""Sums may be reordered, which vector code needs; nothing may be NaN or infinite (nnan, ninf)."""

inlined: Final = njit(
    nogil=True, cache=True, fastmath=FAST_MATH, error_model="numpy", forceinline=True, _nrt=False
)
"""Makes what kernels call a part of them. It allocates nothing and, by ``_nrt``, counts no references to arrays:
each is an atomic operation, and thousands of them a step cost more than the arithmetic of a small problem."""


@inlined
def uniform(seed, counter):
    """A number in [-1, 1) that depends on nothing but its arguments: a hash of both (Murmur3's finaliser)."""
    z = (seed + counter * np.uint64(0x9E3779B9)) & np.uint64(0xFFFFFFFF)
    z = ((z ^ (z >> np.uint64(16))) * np.uint64(0x85EBCA6B)) & np.uint64(0xFFFFFFFF)
    z = ((z ^ (z >> np.uint64(13))) * np.uint64(0xC2B2AE35)) & np.uint64(0xFFFFFFFF)
    z = z ^ (z >> np.uint64(16))
    return F32(z >> np.uint64(8)) * F32(2.0**-23) - F32(1)


@inlined
def clause_rates(c, dt):
    """What ``clause`` needs of the constants and the step: growth, keep, rise, fall, epsilon, top, cap."""
    alpha, beta, gamma, delta, epsilon, one = c[ALPHA], c[BETA], c[GAMMA], c[DELTA], c[EPSILON], F32(1)
    cap = c[LONG_TERM_MAX] - one
    return dt * beta, one - dt * beta * gamma, dt * alpha, -dt * alpha * delta, epsilon, one + epsilon, cap


@inlined
def clause(false_first, false_second, short, long, rates):
    """Advance the memories of one clause of two literals; ``ClauseField`` has the equations.

    Args:
        false_first: How false the first literal is.
        false_second: How false the second one is.
        short: x_s + epsilon.
        long: x_l - 1.
        rates: See ``clause_rates``.

    Returns:
        Both memories, and the push on each literal over the weight of the clause.
    """
    growth, keep, rise, fall, epsilon, top, cap = rates
    zero, one = F32(0), F32(1)
    unsatisfied = min(false_first, false_second)
    short = min(top, max(epsilon, short * (keep + growth * unsatisfied)))
    excess = fall + rise * unsatisfied
    long = min(cap, max(zero, long + excess * (one if excess > zero else long)))
    agile = short - epsilon
    gradient = agile + agile * long
    rigidity = unsatisfied - agile * unsatisfied
    at_first = rigidity if false_first <= false_second else zero
    return short, long, gradient * false_second + at_first, gradient * false_first + (rigidity - at_first)


@inlined
def unit_rates(c):
    """What ``unit_clause`` needs of the constants: alpha, delta, cap, pull."""
    return c[ALPHA], c[DELTA], c[LONG_TERM_MAX] - F32(1), c[UNIT_PULL]


@inlined
def unit_clause(weight, voltage, long, rates, dt):
    """Advance the memory of a unit clause of signed ``weight``, less 1; return it, and the clause's pull."""
    alpha, delta, cap, pull = rates
    zero, half, one = F32(0), F32(0.5), F32(1)
    sign = half if weight > zero else (-half if weight < zero else zero)
    excess = dt * alpha * (half - sign * voltage - delta)
    long = min(cap, max(zero, long + excess * (one if excess > zero else long)))
    return long, pull * weight * (one + long)


@inlined
def bond_rates(c):
    """What ``bond`` needs of the constants: lift, satisfied, delta, zeta, low, cap."""
    one, gamma = F32(1), c[GAMMA]
    return gamma - one, gamma * c[KAPPA], c[DELTA], c[ZETA], c[SHORT_TERM_MIN], c[LONG_TERM_MAX] - one


@inlined
def bond(first, second, short, long, rates, dt):
    """Advance the memories of one bond; ``BondField`` has the equations.

    Args:
        first: The voltage of one end, times the sign of the bond.
        second: That of the other end.
        short: X.
        long: Y - 1.
        rates: See ``bond_rates``.
        dt: The step.
    """
    lift, satisfied, delta, zeta, low, cap = rates
    zero, one = F32(0), F32(1)
    later = min(cap, max(zero, long + dt * (delta * short - zeta)))
    return min(one, max(low, short + dt * (lift - long + satisfied * (first * second)))), later


@inlined
def field_rates(c):
    """What ``bond_field`` needs of the constants: those of memories, drive and pull."""
    of_memories = (c[GAMMA], c[KAPPA], c[DELTA], c[ZETA], c[SHORT_TERM_MIN], c[LONG_TERM_MAX] - F32(1))
    return of_memories, c[ALPHA], F32(2) * c[BETA] / c[PULL_SCALE]


@inlined
def bond_field(field, voltage, short, long, drive, pull, rates, dt):
    """Advance the memories of a field, a bond to a spin at 1.

    Args:
        field: h.
        voltage: That of its spin.
        short: X.
        long: Y - 1.
        drive: What the spin's bonds add up to.
        pull: How strongly they pull it to 0.
        rates: See ``field_rates``.
        dt: The step.

    Returns:
        Both memories, and the rate of the voltage.
    """
    (gamma, kappa, delta, zeta, low, cap), alpha, pull_rate = rates
    zero, one = F32(0), F32(1)
    sign = one if field > zero else (-one if field < zero else zero)
    later = min(cap, max(zero, long + dt * (delta * short - zeta)))
    short = min(one, max(low, short + dt * (gamma * (one + kappa * sign * voltage) - one - long)))
    return short, later, alpha * (drive + field) - pull_rate * (pull + abs(field) * short) * voltage
