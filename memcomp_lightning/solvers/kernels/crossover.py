"""A population of annealed states, in which each keeps of every other what improves it, part by part."""

import numpy as np
from numba import njit

from memcomp_lightning.solvers.kernels import random
from memcomp_lightning.solvers.kernels.annealing import LANES, quench_lanes, start_lanes, sweep_lanes

F32 = np.float32


@njit(nogil=True, cache=True)
def evolve(first_item, last_item, stop, problem, betas, reheat, rounds, thresholds, seeds, best):
    """Anneal populations of ``LANES`` states, then reheat them round by round and cross them.

    Args:
        first_item: Of ``n_problems * n_populations``, problem after problem.
        last_item: One past the last.
        stop: Of one number; other than 0 ends the work: the state of the moment descends, and is the last.
        problem: ``begins (n + 1,)`` where the neighbours of each variable begin, ``neighbours (n_entries,)``,
            ``couplings (n_problems, n_entries)`` and ``own (n_problems, n)``, the linear part.
        betas: Inverse temperatures of the first annealing, ``(n_problems, n_sweeps)``.
        reheat: Least inverse temperature that a round begins with, ``(n_problems,)``, and the largest over it.
        rounds: Their number, the sweeps of each, and the rounds from one crossing of neighbours to the next.
        thresholds: See ``random.thresholds``.
        seeds: ``(n_items,)``.
        best: Out, the states, ``(n_items, n, LANES)`` in {0, 1}; stays what it is where no time was left.
    """
    begins, neighbours, couplings, own = problem
    n_rounds, n_short, cross_every = rounds
    n_problems, n = own.shape
    n_populations = seeds.size // n_problems
    x, kept = np.empty((n, LANES), np.float32), np.empty((n, LANES), np.float32)
    field, kept_field = np.empty_like(x), np.empty_like(x)
    change, energy = np.empty(LANES, np.float32), np.empty(LANES, np.float32)
    differs, queue, state = np.empty(n, np.bool_), np.empty(n, np.int64), np.empty(1, np.uint64)
    for item in range(first_item, last_item):
        if stop[0] and item > first_item:
            return
        p = item // n_populations
        random.begin(state, seeds[item])
        pairs = (begins, neighbours, couplings[p])
        start_lanes(kept, kept_field, pairs, own[p], change, state)
        for beta in betas[p]:
            if stop[0]:
                break
            at = random.below(state, random.N_THRESHOLDS)
            sweep_lanes(kept, kept_field, pairs, thresholds, at, beta, change)
        quench_lanes(kept, kept_field, pairs, own[p], change, energy)
        low, growth = reheat[0][p], reheat[1]
        last = betas[p, betas.shape[1] - 1]
        for number in range(1, n_rounds + 1):
            if stop[0]:
                break
            x[:] = kept
            field[:] = kept_field
            first = low * growth ** (F32(random.below(state, 2**24)) / F32(2**24))
            for sweep in range(n_short):
                beta = first + (last - first) * F32(sweep) / F32(n_short)
                at = random.below(state, random.N_THRESHOLDS)
                sweep_lanes(x, field, pairs, thresholds, at, beta, change)
            quench_lanes(x, field, pairs, own[p], change, energy)
            _cross(kept, kept_field, x, field, pairs, differs, queue)
            if number % cross_every == 0:
                shift = 1 + random.below(state, LANES - 1)
                _rotate(kept, x, shift)
                _rotate(kept_field, field, shift)
                _cross(kept, kept_field, x, field, pairs, differs, queue)
            quench_lanes(kept, kept_field, pairs, own[p], change, energy)
        for i in range(n):
            for lane in range(LANES):
                best[item, i, lane] = kept[i, lane] > F32(0)


@njit(nogil=True, cache=True, forceinline=True)
def _rotate(source, target, shift):
    """Copy each lane to the one ``shift`` places before it."""
    for i in range(source.shape[0]):
        for lane in range(LANES):
            target[i, lane] = source[i, (lane + shift) % LANES]


@njit(nogil=True, cache=True, forceinline=True)
def _cross(x, field, other, other_field, pairs, differs, queue):
    """Take over from another state each part that does not raise the energy, lane by lane.

    A part is a connected component, in the graph, of the variables in which both differ. No two parts are coupled,
    so each changes the energy by an amount of its own: by the sum, over its variables, of the mean of both
    fields.
    """
    begins, neighbours, couplings = pairs
    for lane in range(LANES):
        for i in range(differs.size):
            differs[i] = x[i, lane] != other[i, lane]
        for i in range(differs.size):
            if not differs[i]:
                continue
            differs[i], queue[0] = False, i
            done, found, change = 0, 1, F32(0)
            while done < found:
                j = queue[done]
                done += 1
                change += (other[j, lane] - x[j, lane]) * (field[j, lane] + other_field[j, lane])
                for k in range(begins[j], begins[j + 1]):
                    if differs[neighbours[k]]:
                        differs[neighbours[k]] = False
                        queue[found] = neighbours[k]
                        found += 1
            if change <= F32(0):
                for j in queue[:found]:
                    step = other[j, lane] - x[j, lane]
                    x[j, lane] += step
                    for k in range(begins[j], begins[j + 1]):
                        field[neighbours[k], lane] += step * couplings[k]
