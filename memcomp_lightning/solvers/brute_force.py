"""The exact minimum, by enumeration."""

import time
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.enumeration import binary_states
from memcomp_lightning.problems.graph import Bipartite
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, Status

_NUMBERS = 2**22
"""Numbers held at a time."""


@dataclass(frozen=True, kw_only=True, slots=True)
class BruteForce:
    """Prove the minimum of a small problem by trying every state.

    Of two fully coupled layers only the smaller one is enumerated, as its state fixes the best state of the other;
    problems in int64 are always enumerated whole.

    Attributes:
        max_variables: Largest number of variables to enumerate; 2^max_variables states are examined.
        chunk_size: States examined at a time at most, >= 1; fewer of large problems.
    """

    max_variables: int = 22
    chunk_size: int = 2**16

    def __post_init__(self) -> None:
        require_count("max_variables", self.max_variables)
        require_count("chunk_size", self.chunk_size)

    def minimise(self, qubo: Qubo, *, generator: Generator) -> QuboSolution:
        """Return the minimum as a single restart; the generator is not used.

        Energies of an int64 problem are compared as integers. Of other problems the status is ROUNDED where the
        numbers are integers whose sums float64 rounds.

        Raises:
            SettingError: More variables to enumerate than ``max_variables``.
        """
        begin = time.perf_counter()
        graph = qubo.graph
        exact = qubo.linear.dtype == torch.int64
        layered = isinstance(graph, Bipartite) and not exact
        enumerated = min(graph.n_first, graph.n_second) if isinstance(graph, Bipartite) and layered else qubo.n
        require(
            enumerated <= self.max_variables,
            "number of variables to enumerate",
            enumerated,
            f"at most max_variables = {self.max_variables}",
            "Use a heuristic (DmmSolver, AlternatingDescent), or raise max_variables: each one doubles the time.",
        )
        worst = torch.iinfo(torch.int64).max if exact else torch.inf
        best_energy = torch.full(
            qubo.problems, worst, dtype=torch.int64 if exact else torch.float64, device=qubo.linear.device
        )
        best = qubo.linear.new_zeros(*qubo.problems, enumerated, dtype=torch.float64 if exact else None)
        layers = _Layers(qubo) if layered else None
        at_once = max(1, min(self.chunk_size, _NUMBERS // max(qubo.linear.numel(), 1)))
        for start in range(0, 2**enumerated, at_once):
            stop = min(start + at_once, 2**enumerated)
            states = binary_states(enumerated, start=start, stop=stop, like=best).to(qubo.linear.dtype)
            every = states.expand(*qubo.problems, *states.shape)
            energies, index = (qubo.energy(every) if layers is None else layers.lowest(states)).min(-1)
            best = torch.where((energies < best_energy).unsqueeze(-1), states[index].to(best.dtype), best)
            best_energy = torch.minimum(energies, best_energy)
        if layers is not None:
            best = layers.completed(best)
        assignments = best.unsqueeze(-2).to(qubo.linear.dtype)
        one_each = torch.ones(*qubo.problems, 1, dtype=torch.int64, device=best.device)
        return QuboSolution(
            assignments=assignments,
            energies=qubo.energy(assignments).double(),
            status=torch.where(qubo.rounds().unsqueeze(-1), int(Status.ROUNDED), int(Status.OPTIMAL)),
            steps=one_each * 2**enumerated,
            wall_time_s=time.perf_counter() - begin,
        )


class _Layers:
    """A bipartite problem in float64, seen from its smaller layer: the other layer follows, unit by unit."""

    def __init__(self, qubo: Qubo) -> None:
        graph = qubo.graph
        assert isinstance(graph, Bipartite)
        self._first = graph.n_first <= graph.n_second
        layers = qubo.linear.double().split((graph.n_first, graph.n_second), dim=-1)
        self._linear, self._other = layers if self._first else layers[::-1]
        self._coupling = qubo.coupling.double().mT if self._first else qubo.coupling.double()
        self._offset = qubo.offset.double()

    def lowest(self, states: Float[Tensor, "states n"]) -> Float[Tensor, "*problems states"]:
        """Energy of each state of the smaller layer with the best state of the other."""
        states = states.double()
        # One product for all problems: (states, n) times (n, problems and units).
        flat = self._coupling.movedim(-2, 0).flatten(1)
        field = torch.addmm(self._other.flatten(), states, flat).view(len(states), *self._other.shape)
        own = states @ self._linear.reshape(-1, states.shape[-1]).mT
        energy: Tensor = field.clamp_(max=0.0).sum(-1) + own.view(len(states), *self._offset.shape) + self._offset
        return energy.movedim(0, -1)

    def completed(self, state: Float[Tensor, "*problems n"]) -> Float[Tensor, "*problems n_all"]:
        """One state of the smaller layer for each problem, with the best state of the other."""
        field = (state.double().unsqueeze(-2) @ self._coupling).squeeze(-2) + self._other
        other = (field < 0).to(state.dtype)
        return torch.cat((state, other) if self._first else (other, state), dim=-1)
