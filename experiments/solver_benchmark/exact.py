"""Minima that are proven: branch and bound over one layer of an RBM, and HiGHS on the linearised problem."""

import time
from typing import NamedTuple

import numpy as np
import torch
from scipy.optimize import Bounds, LinearConstraint, milp
from scipy.sparse import coo_array

from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.errors import require
from memcomp_lightning.problems import Bipartite, Qubo
from memcomp_lightning.solvers.kernels.branch_and_bound import search


class Proof(NamedTuple):
    """Lowest energy found, whether it is proven minimal, a lower bound on all energies, and the time it took."""

    energy: float
    proven: bool
    bound: float
    seconds: float


def branch_and_bound(qubo: Qubo, *, incumbent: float = np.inf, max_nodes: int = 10**9) -> Proof:
    """What ``qubo.BranchAndBound`` does, from an energy that is known; a few seconds for a hard 32x32.

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
    weight = np.ascontiguousarray(weight[order])
    best, _, proven, _ = search(weight, linear[order], other, incumbent - offset + margin, max_nodes)
    energy = offset + best
    return Proof(energy, proven, energy if proven else -np.inf, time.perf_counter() - begin)


def highs(qubo: Qubo, *, time_limit: float) -> Proof:
    """Mixed-integer program, y_ij for x_i x_j: y <= x_i and y <= x_j where y pays, else y >= x_i + x_j - 1."""
    pairs, value = to_numpy(qubo.graph.edges()), qubo.coupling.double().flatten().numpy()
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
