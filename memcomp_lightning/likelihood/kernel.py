"""Compiled sum over the last units of the enumerated layer; ``prefixes.py`` says of what."""

import math

import numpy as np
from numba import njit

PACK = 8
"""Factors multiplied in one pass over the states."""

FAST_MATH = {"reassoc", "contract", "nsz", "arcp"}
"""Sums may be reordered, which vector code needs; NaN and infinity keep their meaning."""

_FRACTION = np.int64((1 << 52) - 1)
_ONE = np.int64(1023 << 52)


@njit(nogil=True, cache=True, fastmath=FAST_MATH, error_model="numpy")
def sum_over_second(prefix, second, closes, total, top):
    """For each prefix t, sum over u of ``start_u prod_i (1 + a_ti b_iu) prod_l exp(softplus(x_tl + y_lu))``.

    Each product is a float in [1, 2) times a power of two: it takes no logarithm to keep it in range.

    Args:
        prefix: a, ``(n_prefixes, n_packs * PACK)``, and x, ``(n_prefixes, n_large)``.
        second: b and y, a column for each state u; start, its fraction and exponent, ``(n_states,)``.
        closes: After which packs the exponents are split off, ``(n_packs,)`` bool.
        total: Out, ``(n_prefixes,)``: the sum over ``2^top``.
        top: Out, ``(n_prefixes,)`` int64.
    """
    a, x = prefix
    b, y, start, start_exponent = second
    n_states = start.size
    product, exponent = np.empty(n_states), np.empty(n_states, np.int64)
    scale, log_large = np.empty(n_states), np.empty(n_states)
    bits, scale_bits = product.view(np.int64), scale.view(np.int64)
    for t in range(a.shape[0]):
        product[:] = start
        exponent[:] = start_exponent
        for pack in range(closes.size):
            i = PACK * pack
            _multiply(product, a[t, i : i + PACK], b[i : i + PACK])
            if closes[pack]:
                _split(bits, exponent)
        if x.shape[1] > 0:
            _log_of_large(x[t], y, log_large)
            for u in range(n_states):
                whole = math.floor(log_large[u] / math.log(2.0))
                product[u] *= math.exp(log_large[u] - whole * math.log(2.0))
                exponent[u] += np.int64(whole)
        most = exponent[0]
        for u in range(n_states):
            most = max(most, exponent[u])
        for u in range(n_states):
            scale_bits[u] = (max(exponent[u] - most, -1022) + 1023) << 52
        summed = 0.0
        for u in range(n_states):
            summed += product[u] * scale[u]
        total[t], top[t] = summed, most


@njit(nogil=True, inline="always", fastmath=FAST_MATH)
def _multiply(product, a, b):
    """Multiply by the eight factors of a pack."""
    a0, a1, a2, a3, a4, a5, a6, a7 = a[0], a[1], a[2], a[3], a[4], a[5], a[6], a[7]
    b0, b1, b2, b3, b4, b5, b6, b7 = b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]
    for u in range(product.size):
        left = ((1.0 + a0 * b0[u]) * (1.0 + a1 * b1[u])) * ((1.0 + a2 * b2[u]) * (1.0 + a3 * b3[u]))
        right = ((1.0 + a4 * b4[u]) * (1.0 + a5 * b5[u])) * ((1.0 + a6 * b6[u]) * (1.0 + a7 * b7[u]))
        product[u] *= left * right


@njit(nogil=True, inline="always")
def _split(bits, exponent):
    """Move the powers of two of positive normal floats, given by their bits, to ``exponent``."""
    for u in range(bits.size):
        exponent[u] += (bits[u] >> 52) - 1023
        bits[u] = (bits[u] & _FRACTION) | _ONE


@njit(nogil=True, inline="always")
def _log_of_large(x, y, log_large):
    """Sum of softplus over the units whose field may leave the range of exp."""
    log_large[:] = 0.0
    for i in range(x.size):
        for u in range(log_large.size):
            field = x[i] + y[i, u]
            if field > 40.0:
                log_large[u] += field
            elif field > -750.0:
                log_large[u] += math.log1p(math.exp(field))
