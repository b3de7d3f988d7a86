"""One-flip tabu search in whole numbers: no field drifts, and equal energies are equal."""

import numpy as np
from numba import njit
from numba.extending import overload

from memcomp_lightning.solvers.kernels import random

LARGEST = 2**30
"""More than any change of the energy: the couplings of a variable are scaled to add up to less than half."""

_FORBIDDEN = np.int32(LARGEST)
_ALWAYS = np.int32(2**31 - 1)


@njit(nogil=True, cache=True)
def search(first_item, last_item, stop, problem, own, n_steps, settings, seeds, best, found_at):
    """Search from the given states, restarts ``first_item`` to ``last_item - 1``.

    Each step flips the variable that lowers the energy most, or raises it least, among those that have not flipped
    lately. A variable that leads below the best energy may always flip. Where nothing better was found for long,
    the search goes back to its best state and flips some variables of it at random.

    Args:
        first_item: Of ``n_problems * n_restarts``, problem after problem.
        last_item: One past the last.
        stop: Of one number; other than 0 ends the work with what was found so far.
        problem: Of int32: ``of_first (n_problems, n_first, n_second)`` and its transpose, for two full layers; or
            ``begins (n + 1,)``, ``neighbours (n_entries,)`` and ``couplings (n_problems, n_entries)``.
        own: The linear part, ``(n_problems, n)`` int32.
        n_steps: Flips of a restart.
        settings: Steps for which a variable does not flip back, the range of what is added to it at random, the
            steps without anything better before the search goes back, and the variables that it flips then.
        seeds: ``(n_items,)``.
        best: In, where to start; out, the best state, ``(n_items, n)`` in {0, 1}.
        found_at: Out, its step, ``(n_items,)``; stays what it is where no time was left.
    """
    tenure, spread, patience, n_kicked = settings
    n_problems, n = own.shape
    n_restarts = seeds.size // n_problems
    # change: of the energy if a variable flips. on: -1 (all bits) of a variable that is on, else 0.
    change, on = np.empty(n, np.int32), np.empty(n, np.int32)
    on_at_best, free_from = np.empty(n, np.int32), np.empty(n, np.int32)
    state = np.empty(1, np.uint64)
    for item in range(first_item, last_item):
        if stop[0] and item > first_item:
            return
        p = item // n_restarts
        random.begin(state, seeds[item])
        change[:] = own[p]
        on[:] = 0
        free_from[:] = 0
        energy = np.int64(0)
        for i in range(n):
            if best[item, i]:
                energy += change[i]
                _flip(problem, p, i, change, on)
        lowest, lowest_at, on_at_best[:] = energy, 0, on
        lately, lately_at = energy, 0
        for step in range(1, n_steps + 1):
            if stop[0]:
                break
            of_all, of_free = _smallest(change, free_from, step)
            wanted, latest = (of_all, _ALWAYS) if energy + of_all < lowest else (of_free, np.int32(step))
            if wanted == _FORBIDDEN:
                i = random.below(state, n)
            else:
                i = np.int64(_find(change, free_from, latest, wanted, np.int32(random.below(state, n))))
            energy += change[i]
            _flip(problem, p, i, change, on)
            free_from[i] = step + 1 + tenure + random.below(state, spread)
            if energy < lowest:
                lowest, lowest_at, on_at_best[:] = energy, step, on
            if energy < lately:
                lately, lately_at = energy, step
            elif step - lately_at > patience:
                for j in range(n):
                    if on[j] != on_at_best[j]:
                        energy += change[j]
                        _flip(problem, p, j, change, on)
                for _ in range(n_kicked):
                    j = random.below(state, n)
                    energy += change[j]
                    _flip(problem, p, j, change, on)
                free_from[:] = 0
                lately, lately_at = energy, step
        for i in range(n):
            best[item, i] = on_at_best[i] != 0
        found_at[item] = lowest_at


@njit(nogil=True, cache=True, forceinline=True)
def _smallest(change, free_from, step):
    """The smallest change of all variables, and of those that may flip."""
    of_all, of_free, now = _FORBIDDEN, _FORBIDDEN, np.int32(step)
    for i in range(change.size):
        of_all = min(of_all, change[i])
        of_free = min(of_free, change[i] if free_from[i] <= now else _FORBIDDEN)
    return of_all, of_free


@njit(nogil=True, cache=True, forceinline=True)
def _find(change, free_from, latest, wanted, order):
    """A variable with this change that is free at the latest step; of several the first after they are reordered.

    Exclusive or with ``order`` reorders them, without a branch that vector code could not take.
    """
    first = _FORBIDDEN
    for i in range(change.size):
        place = np.int32(i) ^ order
        fits = (change[i] == wanted) & (free_from[i] <= latest)
        first = min(first, place if fits else _FORBIDDEN)
    return first ^ order


def _flip(problem, p, i, change, on):
    """Flip variable i: a stub that numba fills in by the layout of the problem."""
    raise NotImplementedError


@overload(_flip, inline="always")
def _flip_of(problem, p, i, change, on):
    return _flip_in_layers if len(problem) == 2 else _flip_in_pairs


def _flip_in_layers(problem, p, i, change, on):
    of_first, of_second = problem
    n_first = of_first.shape[1]
    if i < n_first:
        _update_row(change[n_first:], on[n_first:], of_first[p, i], on[i])
    else:
        _update_row(change[:n_first], on[:n_first], of_second[p, i - n_first], on[i])
    change[i] = -change[i]
    on[i] = ~on[i]


def _flip_in_pairs(problem, p, i, change, on):
    begins, neighbours, couplings = problem
    for k in range(begins[i], begins[i + 1]):
        j = neighbours[k]
        mask = on[j] ^ on[i]
        change[j] += (couplings[p, k] ^ mask) - mask
    change[i] = -change[i]
    on[i] = ~on[i]


@njit(nogil=True, cache=True, forceinline=True)
def _update_row(change, on, row, is_on):
    """Add a row with the sign of both states: exclusive or with -1, less -1, is the negative."""
    for j in range(change.size):
        mask = on[j] ^ is_on
        change[j] += (row[j] ^ mask) - mask
