"""Descent by blocks of uncoupled variables from random starts."""

import time
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require_count
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, Status


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

    def minimise(self, qubo: Qubo, *, generator: Generator) -> QuboSolution:
        """Return one local minimum a start."""
        begin = time.perf_counter()
        shape = (*qubo.problems, self.n_restarts, qubo.n)
        x = (rng.uniform(shape, generator=generator, like=qubo.linear) < 0.5).to(qubo.linear.dtype)
        steps = torch.zeros(shape[:-1], dtype=torch.int64, device=x.device)
        moving = torch.ones(shape[:-1], dtype=torch.bool, device=x.device)
        for _ in range(self.max_sweeps):
            before = x.clone()
            descend(qubo, x)
            steps += moving
            moving = (x != before).any(-1)
            if not bool(moving.any()):
                break
        status = torch.where(moving, int(Status.STEP_BUDGET), int(Status.CONVERGED))
        return QuboSolution(
            assignments=x,
            energies=qubo.energy(x),
            status=status,
            steps=steps,
            wall_time_s=time.perf_counter() - begin,
        )


def descend(qubo: Qubo, x: Tensor) -> None:
    """Set each block of ``x`` in turn to its optimum given the rest, in place."""
    for block in qubo.graph.blocks():
        field = qubo.field(x)[..., block]
        # A tie keeps its value, so that equal energies cannot alternate for ever.
        x[..., block] = torch.where(field == 0, x[..., block], (field < 0).to(x.dtype))
