"""The proven minimum of two fully coupled layers, by branch and bound."""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning import compiling
from memcomp_lightning.arrays import alike, cast, to_numpy
from memcomp_lightning.errors import SettingError, require_count
from memcomp_lightning.problems.graph import Bipartite
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.alternating_descent import AlternatingDescent
from memcomp_lightning.solvers.base import QuboSolution, Status

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


@dataclass(frozen=True, kw_only=True, slots=True)
class BranchAndBound:
    r"""Prove the minimum of two fully coupled layers that are too large for ``BruteForce``. Needs numba.

    The units of the smaller layer are set one by one; each unit of the larger one then takes its best value. With
    the fields f of the larger layer the energy is concave in the smaller one: own + \sum_k min(0, f_k). The units
    not yet set leave f_k a range. On it the chord of min(0, f_k) lies below the function and is linear in these
    units, so its minimum is a bound. Trained 32x32 RBMs take milliseconds, random ones whose biases cancel the
    mean field seconds.

    Attributes:
        max_nodes: Partial states to look at before a problem is given up, >= 1; its best state is still returned.
    """

    max_nodes: int = 10**8

    def __post_init__(self) -> None:
        require_count("max_nodes", self.max_nodes)

    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return one assignment for each problem, OPTIMAL where it is proven up to the rounding of float64.

        For integers whose sums float64 holds, the proof is exact; where it rounds the sums, the status is ROUNDED.

        The generator draws the starts of a descent: with its energy the search can skip most states.

        Raises:
            SettingError: The problem is not of two fully coupled layers.
        """
        from memcomp_lightning.solvers.kernels.branch_and_bound import search

        begin = time.perf_counter() - compiling.seconds_spent()
        qubo = qubo.floating()
        graph = qubo.graph
        if not isinstance(graph, Bipartite):
            raise SettingError(
                f"graph = {type(graph).__name__} is not allowed: BranchAndBound takes two fully coupled layers "
                "(Bipartite). Use BruteForce or a heuristic (DmmSolver)."
            )
        known = AlternatingDescent().minimise(qubo, generator=generator)
        incumbent = to_numpy(known.best_energy - qubo.offset).ravel().tolist()
        best = to_numpy(known.best).reshape(-1, qubo.n).copy()
        coupling = to_numpy(qubo.coupling).reshape(-1, graph.n_second, graph.n_first).astype(np.float64)
        linear = to_numpy(qubo.linear).reshape(-1, qubo.n).astype(np.float64)
        status, nodes = [], []
        for p, energy in enumerate(incumbent):
            weight, own, other = coupling[p].T, *np.split(linear[p], [graph.n_first])
            second_is_smaller = graph.n_first > graph.n_second
            if second_is_smaller:
                weight, own, other = weight.T, other, own
            order = np.argsort(-np.abs(weight).sum(1))
            weight = np.ascontiguousarray(weight[order])
            margin, complete = _margin(weight, own, other)
            limit = energy - margin
            lowest, state, proven, n_nodes = search(weight, own[order], other, limit, self.max_nodes)
            if lowest < limit:
                smaller, larger = np.empty(len(order)), other + state @ weight < 0
                smaller[order] = state
                layers = (larger, smaller) if second_is_smaller else (smaller, larger)
                best[p] = np.concatenate(layers)
            status.append(int(complete if proven else Status.STEP_BUDGET))
            nodes.append(n_nodes)
        assignments = cast(alike(best.reshape(*qubo.problems, 1, qubo.n), qubo.linear), qubo.linear.dtype)
        each = (*qubo.problems, 1)
        return QuboSolution(
            assignments=assignments,
            energies=qubo.energy(assignments),
            status=alike(np.reshape(status, each), assignments),
            steps=alike(np.reshape(nodes, each), assignments),
            wall_time_s=time.perf_counter() - compiling.seconds_spent() - begin,
        )


def _margin(*numbers: NDArray[np.float64]) -> tuple[float, Status]:
    """How far below the known energy a state must lie to be new, and the status of a search that came to its end.

    For integers it is half of the smallest difference between their sums, which makes the proof exact; for other
    numbers it is the error of a sum in float64, so that states of equal energy are not searched again and again.
    """
    size = float(sum(np.abs(part).sum() for part in numbers))
    error = size * sum(part.size for part in numbers) * float(np.finfo(np.float64).eps)
    if any((part != np.rint(part)).any() for part in numbers):
        return error, Status.OPTIMAL
    return (0.5, Status.OPTIMAL) if error < 0.5 else (error, Status.ROUNDED)
