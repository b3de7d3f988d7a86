"""Minima that are proven: branch and bound over one layer of an RBM, and HiGHS on the linearised problem."""

import time
from typing import NamedTuple

import numba
import numpy as np
import torch
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from memcomp_lightning.errors import require
from memcomp_lightning.qubo import Bipartite, Qubo


class Proof(NamedTuple):
    """Lowest energy found, whether it is proven minimal, a lower bound on all energies, and the time it took."""

    energy: float
    proven: bool
    bound: float
    seconds: float


def branch_and_bound(qubo: Qubo, *, incumbent: float = np.inf, max_nodes: int = 10**9) -> Proof:
    """Search the states of an RBM's smaller layer, the other layer follows; a few seconds for a hard 32x32.

    With the fields f of the larger layer the energy is concave in the smaller one: own + sum_k min(0, f_k).
    Over the range that the units not yet set leave to f_k, the chord of min(0, f_k) lies below it and is linear
    in them, so its minimum is a bound.

    Args:
        qubo: A problem on a bipartite graph.
        incumbent: An energy known to be reached; a good one saves most of the work.
        max_nodes: States of part of the layer to look at before giving up.
    """
    graph = qubo.graph
    require(isinstance(graph, Bipartite), "graph", type(graph).__name__, "Bipartite")
    weight = qubo.coupling.double().numpy().T
    linear, other = (part.double().numpy() for part in graph.split(qubo.linear))
    if graph.n_first > graph.n_second:
        weight, linear, other = weight.T, other, linear
    order = np.argsort(-np.abs(weight).sum(1))
    offset, margin = float(qubo.offset), 1e-6 * max(abs(incumbent), 1e-3) if incumbent < np.inf else 0.0
    begin = time.perf_counter()
    best, proven = _search(
        np.ascontiguousarray(weight[order]), linear[order], other, incumbent - offset + margin, max_nodes
    )
    energy = offset + best
    return Proof(energy, proven, energy if proven else -np.inf, time.perf_counter() - begin)


@numba.njit(fastmath=True, cache=True)
def _search(
    weight: np.ndarray, linear: np.ndarray, other: np.ndarray, best: float, max_nodes: int
) -> tuple[float, bool]:
    """Depth first; unit d is at 0, then at 1, then free again."""
    n, m = weight.shape
    low, high = np.zeros((n + 1, m)), np.zeros((n + 1, m))  # what the units from d on can add to a field
    for d in range(n - 1, -1, -1):
        low[d] = low[d + 1] + np.minimum(weight[d], 0.0)
        high[d] = high[d + 1] + np.maximum(weight[d], 0.0)
    field, own, value, slope = np.empty((n + 1, m)), np.zeros(n + 1), np.full(n + 1, -1), np.empty(m)
    field[0] = other
    d = 0
    for _ in range(max_nodes):
        value[d] += 1
        if value[d] == 2:
            value[d] = -1
            d -= 1
            if d < 0:
                return best, True
            continue
        own[d + 1] = own[d] + value[d] * linear[d]
        bound = own[d + 1]
        for k in range(m):
            field[d + 1, k] = field[d, k] + value[d] * weight[d, k]
            least, most = field[d + 1, k] + low[d + 1, k], field[d + 1, k] + high[d + 1, k]
            if most <= 0:
                slope[k] = 1.0
                bound += field[d + 1, k]
            elif least >= 0:
                slope[k] = 0.0
            else:
                slope[k] = least / (least - most)
                bound += least - slope[k] * low[d + 1, k]
        for later in range(d + 1, n):
            gain = linear[later]
            for k in range(m):
                gain += slope[k] * weight[later, k]
            bound += min(gain, 0.0)
        if bound < best:
            if d + 1 == n:
                best = bound
            else:
                d += 1
    return best, False


def highs(qubo: Qubo, *, time_limit: float) -> Proof:
    """Mixed-integer program, y_ij for x_i x_j: y <= x_i and y <= x_j where y pays, else y >= x_i + x_j - 1."""
    pairs, value = qubo.graph.edges().numpy(), qubo.coupling.double().flatten().numpy()
    pairs, value = pairs[value != 0], value[value != 0]
    n, m = qubo.n, len(value)
    rows, columns, entries, upper = [], [], [], []
    for k, (i, j) in enumerate(pairs):
        pays = value[k] < 0
        constraints = [((i, -1), (n + k, 1)), ((j, -1), (n + k, 1))] if pays else [((i, 1), (j, 1), (n + k, -1))]
        for constraint in constraints:
            rows += [len(upper)] * len(constraint)
            columns += [column for column, _ in constraint]
            entries += [entry for _, entry in constraint]
            upper.append(0 if pays else 1)
    matrix = coo_array((entries, (rows, columns)), shape=(len(upper), n + m)).tocsr()
    begin = time.perf_counter()
    result = milp(
        np.concatenate((qubo.linear.double().numpy(), value)),
        integrality=np.repeat([1, 0], [n, m]),
        bounds=Bounds(0, 1),
        constraints=LinearConstraint(matrix, -np.inf, np.array(upper)) if upper else None,
        options={"time_limit": time_limit, "mip_rel_gap": 0.0},
    )
    seconds, offset = time.perf_counter() - begin, float(qubo.offset)
    bound = offset + (-np.inf if result.mip_dual_bound is None else result.mip_dual_bound)
    if result.x is None:
        return Proof(np.inf, False, bound, seconds)
    x = torch.from_numpy(result.x[:n]).round().unsqueeze(0)
    return Proof(float(qubo.energy(x)), result.status == 0, bound, seconds)
