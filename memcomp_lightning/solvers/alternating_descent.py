"""Descent by blocks of uncoupled variables from random starts."""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from memcomp_lightning import rng
from memcomp_lightning.arrays import Array, cast, namespace
from memcomp_lightning.errors import require_count
from memcomp_lightning.problems.graph import Bipartite
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, Status

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


@dataclass(frozen=True, kw_only=True, slots=True)
class AlternatingDescent:
    """Find local minima: set block after block to its optimum given the rest, until nothing changes.

    In an RBM the blocks are the two layers; elsewhere they are single variables. The energy never rises.

    Attributes:
        n_restarts: Random starts for each problem, >= 1.
        max_sweeps: Sweeps over all blocks after which a start is given up, >= 1.
    """

    n_restarts: int = 28
    max_sweeps: int = 1000

    def __post_init__(self) -> None:
        require_count("n_restarts", self.n_restarts)
        require_count("max_sweeps", self.max_sweeps)

    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return one local minimum a start."""
        begin, qubo = time.perf_counter(), qubo.floating()
        xp = namespace(qubo.linear)
        x = random_states(qubo, self.n_restarts, generator)
        moving = xp.ones(x.shape[:-1], dtype=xp.bool, device=x.device)
        steps = xp.zeros(x.shape[:-1], dtype=xp.int64, device=x.device)
        for _ in range(self.max_sweeps):
            before = xp.asarray(x, copy=True)
            descend(qubo, x)
            steps += moving
            moving = (x != before).any(-1)
            if not bool(moving.any()):
                break
        status = xp.where(moving, int(Status.STEP_BUDGET), int(Status.CONVERGED))
        return QuboSolution(
            assignments=x,
            energies=qubo.energy(x),
            status=status,
            steps=steps,
            wall_time_s=time.perf_counter() - begin,
        )


def random_states(qubo: Qubo, n_restarts: int, generator: "Generator") -> Array:
    """Independent random states ``(*problems, n_restarts, n)`` in {0, 1}.

    Of two layers every other state has the second at its optimum given the first. What descends from there may
    end elsewhere than what begins with the first: the modes of trained RBMs are found from one side alone.
    """
    shape = (*qubo.problems, n_restarts, qubo.n)
    x = cast(rng.uniform(shape, generator=generator, like=qubo.linear) < 0.5, qubo.linear.dtype)
    if isinstance(qubo.graph, Bipartite):
        second = slice(qubo.graph.n_first, None)
        x[..., ::2, second] = cast(qubo.field(x[..., ::2, :])[..., second] < 0, x.dtype)
    return x


def descend(qubo: Qubo, x: Array) -> None:
    """Set each block of ``x`` in turn to its optimum given the rest, in place."""
    for block in qubo.graph.blocks():
        field = qubo.field(x)[..., block]
        # A tie keeps its value, so that equal energies cannot alternate for ever.
        x[..., block] = namespace(x).where(field == 0, x[..., block], cast(field < 0, x.dtype))
