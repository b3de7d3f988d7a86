"""The exact minimum, by enumeration."""

import time
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.enumeration import binary_states
from memcomp_lightning.qubo.graph import Bipartite
from memcomp_lightning.qubo.qubo import Qubo, QuboSolution, Status


@dataclass(frozen=True, kw_only=True, slots=True)
class BruteForce:
    """Try every state; of a bipartite problem every state of the smaller layer, the other one follows.

    Attributes:
        max_variables: Largest number of variables to enumerate; 2^max_variables states are examined.
        chunk_size: States examined at a time, >= 1.
    """

    max_variables: int = 22
    chunk_size: int = 2**16

    def __post_init__(self) -> None:
        require_count("max_variables", self.max_variables)
        require_count("chunk_size", self.chunk_size)

    def minimise(self, qubo: Qubo, *, generator: Generator) -> QuboSolution:
        """Return the minimum as a single restart; the generator is not used.

        Raises:
            SettingError: More variables to enumerate than ``max_variables``.
        """
        begin = time.perf_counter()
        graph = qubo.graph
        enumerated = min(graph.n_first, graph.n_second) if isinstance(graph, Bipartite) else qubo.n
        require(
            enumerated <= self.max_variables,
            "number of variables to enumerate",
            enumerated,
            f"at most max_variables = {self.max_variables}",
            "Use a heuristic (DmmSolver, AlternatingDescent), or raise max_variables: each one doubles the time.",
        )
        best_energy = torch.full(qubo.problems, torch.inf, dtype=torch.float64, device=qubo.linear.device)
        best = qubo.linear.new_zeros(*qubo.problems, qubo.n)
        for start in range(0, 2**enumerated, self.chunk_size):
            stop = min(start + self.chunk_size, 2**enumerated)
            states = self._complete(qubo, binary_states(enumerated, start=start, stop=stop, like=qubo.linear))
            energies, index = qubo.energy(states).min(-1)
            chosen = states.take_along_dim(index[..., None, None], dim=-2).squeeze(-2)
            best = torch.where((energies < best_energy).unsqueeze(-1), chosen, best)
            best_energy = torch.minimum(energies, best_energy)
        assignments = best.unsqueeze(-2)
        one_each = torch.ones(*qubo.problems, 1, dtype=torch.int64, device=best.device)
        return QuboSolution(
            assignments=assignments,
            energies=qubo.energy(assignments),
            status=one_each * int(Status.OPTIMAL),
            steps=one_each * 2**enumerated,
            wall_time_s=time.perf_counter() - begin,
        )

    @staticmethod
    def _complete(qubo: Qubo, states: Tensor) -> Tensor:
        """All variables for each enumerated state: the other layer of a bipartite problem is set optimally."""
        states = states.expand(*qubo.problems, *states.shape)
        graph = qubo.graph
        if not isinstance(graph, Bipartite):
            return states
        if graph.n_first <= graph.n_second:
            other = states @ qubo.coupling.mT + qubo.linear[..., None, graph.n_first :]
            return torch.cat((states, (other < 0).to(states.dtype)), dim=-1)
        other = states @ qubo.coupling + qubo.linear[..., None, : graph.n_first]
        return torch.cat(((other < 0).to(states.dtype), states), dim=-1)
