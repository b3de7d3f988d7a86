"""Simulated annealing by blocks of uncoupled variables."""

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from memcomp_lightning import rng
from memcomp_lightning.arrays import Array, cast, double, namespace, sigmoid
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.alternating_descent import descend, random_states
from memcomp_lightning.solvers.base import QuboSolution, Status

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


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

    @np.errstate(under="ignore")
    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return the end of each restart."""
        begin, qubo = time.perf_counter(), qubo.floating()
        xp = namespace(qubo.linear)
        x = random_states(qubo, self.n_restarts, generator)
        blocks, scale = list(qubo.graph.blocks()), _scale(qubo)
        growth = self.beta_last / self.beta_first
        for beta in (self.beta_first * np.logspace(0, 1, self.n_sweeps, base=growth)).tolist():
            beta_here = cast(beta / scale, x.dtype)[..., None, None]
            for block in blocks:
                p = sigmoid(-beta_here * qubo.field(x)[..., block])
                x[..., block] = rng.bernoulli(p, generator=generator)
        for _ in range(_DESCENTS):
            descend(qubo, x)
        ones = xp.ones(x.shape[:-1], dtype=xp.int64, device=x.device)
        return QuboSolution(
            assignments=x,
            energies=qubo.energy(x),
            status=ones * int(Status.STEP_BUDGET),
            steps=ones * self.n_sweeps,
            wall_time_s=time.perf_counter() - begin,
        )


_DESCENTS = 3
"""Sweeps at zero temperature that close."""


def _scale(qubo: Qubo) -> Array:
    """Root mean square over the variables of the norm of their spin couplings, ``(*problems,)``."""
    power = (double(qubo.coupling) / 4) ** 2
    scale = qubo.graph.scatter(power, power).mean(-1) ** 0.5
    return namespace(scale).where(scale > 0, scale, 1.0)
