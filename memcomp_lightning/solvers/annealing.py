"""Simulated annealing by blocks of uncoupled variables."""

import time
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.alternating_descent import descend
from memcomp_lightning.solvers.base import QuboSolution, Status


@dataclass(frozen=True, kw_only=True, slots=True)
class GibbsAnnealing:
    r"""Solve QUBOs by simulated annealing: block-Gibbs sweeps at a rising inverse temperature, then descent.

    The blocks of an RBM are its layers. Inverse temperatures are geometric from ``beta_first / s`` to
    ``beta_last / s``. The scale of the problem is ``s = \sqrt{mean_i \sum_j (Q_ij / 4)^2}`` with the couplings
    Q_ij / 4 of the spin form; 1 where nothing is coupled.

    Attributes:
        n_restarts: Random starts for each problem, >= 1.
        n_sweeps: Sweeps over all blocks, >= 1.
        beta_first: Inverse temperature of the first sweep in units of 1 / s, > 0.
        beta_last: Inverse temperature of the last sweep in units of 1 / s, >= beta_first.
    """

    n_restarts: int = 28
    n_sweeps: int = 100
    beta_first: float = 0.4
    beta_last: float = 12.0

    def __post_init__(self) -> None:
        require_count("n_restarts", self.n_restarts)
        require_count("n_sweeps", self.n_sweeps)
        require(self.beta_first > 0, "beta_first", self.beta_first, "a number > 0")
        allowed = f"a number >= beta_first = {self.beta_first}"
        require(self.beta_last >= self.beta_first, "beta_last", self.beta_last, allowed)

    def minimise(self, qubo: Qubo, *, generator: Generator) -> QuboSolution:
        """Return the end of each restart."""
        begin = time.perf_counter()
        shape = (*qubo.problems, self.n_restarts, qubo.n)
        x = (rng.uniform(shape, generator=generator, like=qubo.linear) < 0.5).to(qubo.linear.dtype)
        blocks, scale = list(qubo.graph.blocks()), _scale(qubo)
        growth = self.beta_last / self.beta_first
        per_scale = torch.logspace(0, 1, self.n_sweeps, base=growth, dtype=torch.float64, device="cpu")
        for beta in (self.beta_first * per_scale).tolist():
            beta_here = (beta / scale).to(x.dtype)[..., None, None]
            for block in blocks:
                p = torch.sigmoid(-beta_here * qubo.field(x)[..., block])
                x[..., block] = rng.bernoulli(p, generator=generator)
        for _ in range(_DESCENTS):
            descend(qubo, x)
        ones = torch.ones(shape[:-1], dtype=torch.int64, device=x.device)
        return QuboSolution(
            assignments=x,
            energies=qubo.energy(x),
            status=ones * int(Status.STEP_BUDGET),
            steps=ones * self.n_sweeps,
            wall_time_s=time.perf_counter() - begin,
        )


_DESCENTS = 3
"""Sweeps at zero temperature that close."""


def _scale(qubo: Qubo) -> Tensor:
    """Root mean square over the variables of the norm of their spin couplings, ``(*problems,)``."""
    power = (qubo.coupling.double() / 4).square()
    per_variable = qubo.graph.scatter(power, power)
    scale = per_variable.mean(-1).sqrt()
    return torch.where(scale > 0, scale, 1)
