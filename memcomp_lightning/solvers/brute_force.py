"""The exact minimum, by enumeration."""

import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from jaxtyping import Float

from memcomp_lightning.arrays import Array, cast, double, namespace
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.problems.graph import Bipartite
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, Status

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator

_NUMBERS = 2**18
"""Numbers held at a time: they stay in a processor's cache."""


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

    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return the minimum as a single restart; the generator is not used.

        Energies of an int64 problem are compared as integers. Of other problems the status is ROUNDED where the
        numbers are integers whose sums float64 rounds.

        Raises:
            SettingError: More variables to enumerate than ``max_variables``.
        """
        begin, xp = time.perf_counter(), namespace(qubo.linear)
        graph, device = qubo.graph, qubo.linear.device
        exact = qubo.linear.dtype == xp.int64
        layered = isinstance(graph, Bipartite) and not exact
        enumerated = min(graph.n_first, graph.n_second) if isinstance(graph, Bipartite) and layered else qubo.n
        require(
            enumerated <= self.max_variables,
            "number of variables to enumerate",
            enumerated,
            f"at most max_variables = {self.max_variables}",
            "Use a heuristic (DmmSolver, AlternatingDescent), or raise max_variables: each one doubles the time.",
        )
        worst, of_energies = (2**63 - 1, xp.int64) if exact else (xp.inf, xp.float64)
        best_energy = xp.full(qubo.problems, worst, dtype=of_energies, device=device)
        of_states = xp.float64 if exact else qubo.linear.dtype
        best = xp.zeros((*qubo.problems, enumerated), dtype=of_states, device=device)
        layers = _Layers(qubo) if layered else None
        at_once = max(1, min(self.chunk_size, _NUMBERS // max(math.prod(qubo.linear.shape), 1)))
        for start in range(0, 2**enumerated, at_once):
            stop = min(start + at_once, 2**enumerated)
            states = cast(binary_states(enumerated, start=start, stop=stop, like=best), qubo.linear.dtype)
            every = xp.broadcast_to(states, (*qubo.problems, *states.shape))
            energies = qubo.energy(every) if layers is None else layers.lowest(states)
            index, lowest = energies.argmin(-1), xp.min(energies, axis=-1)
            best = xp.where((lowest < best_energy)[..., None], cast(states[index], of_states), best)
            best_energy = xp.minimum(lowest, best_energy)
        if layers is not None:
            best = layers.completed(best)
        assignments = cast(best[..., None, :], qubo.linear.dtype)
        return QuboSolution(
            assignments=assignments,
            energies=double(qubo.energy(assignments)),
            status=xp.where(qubo.rounds()[..., None], int(Status.ROUNDED), int(Status.OPTIMAL)),
            steps=xp.full((*qubo.problems, 1), 2**enumerated, dtype=xp.int64, device=device),
            wall_time_s=time.perf_counter() - begin,
        )


class _Layers:
    """A bipartite problem in float64, seen from its smaller layer: the other layer follows, unit by unit."""

    def __init__(self, qubo: Qubo) -> None:
        graph = qubo.graph
        assert isinstance(graph, Bipartite)
        self._first = graph.n_first <= graph.n_second
        layers = graph.split(double(qubo.linear))
        self._linear, self._other = layers if self._first else layers[::-1]
        self._coupling = double(qubo.coupling).mT if self._first else double(qubo.coupling)
        self._offset = double(qubo.offset)

    def lowest(self, states: Float[Array, "states n"]) -> Float[Array, "*problems states"]:
        """Energy of each state of the smaller layer with the best state of the other."""
        states, n, xp = double(states), len(states), namespace(states)
        # One product for all problems: (states, n) times (n, problems and units).
        flat = xp.moveaxis(self._coupling, -2, 0).reshape(states.shape[-1], -1)
        field = (states @ flat).reshape(n, *self._other.shape)
        field += self._other
        zero = xp.zeros((), dtype=xp.float64, device=field.device)
        own = (states @ self._linear.reshape(-1, states.shape[-1]).mT).reshape(n, *self._offset.shape)
        energy = xp.minimum(field, zero).sum(-1) + own + self._offset
        return xp.moveaxis(energy, 0, -1)

    def completed(self, state: Float[Array, "*problems n"]) -> Float[Array, "*problems n_all"]:
        """One state of the smaller layer for each problem, with the best state of the other."""
        field = (double(state)[..., None, :] @ self._coupling)[..., 0, :] + self._other
        other = cast(field < 0, state.dtype)
        return namespace(state).concat((state, other) if self._first else (other, state), axis=-1)
