"""The solver for who does not want to choose one."""

import math
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from memcomp_lightning import compiling
from memcomp_lightning.arrays import is_floating
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.problems.graph import Bipartite
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.annealing import GibbsAnnealing
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver
from memcomp_lightning.solvers.brute_force import BruteForce
from memcomp_lightning.solvers.compiled import without_zeros
from memcomp_lightning.solvers.crossover import CrossoverAnnealing
from memcomp_lightning.solvers.proofs import parts_of, rounding
from memcomp_lightning.solvers.tabu import MOST, TabuSearch

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator

MOST_ENUMERATED = 12
"""Variables up to which enumeration is as quick as any search, and a proof."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Portfolio:
    """Solve QUBOs by what suits them.

    Few variables are enumerated, sparse graphs annealed with crossover. In two full layers an eighth of the
    restarts anneal and an eighth search by tabu, each for about the same time; where the best of them differ, the
    better method does the rest, where they agree, both do. In other dense problems half of the restarts are
    annealed with crossover before that. What was found decides, not a clock: the same seed gives the same answer
    on every machine.

    Attributes:
        n_restarts: Starts for each problem, >= 1.
        effort: Factor > 0 on the sweeps and steps of each restart.
    """

    n_restarts: int = 28
    effort: float = 1.0

    def __post_init__(self) -> None:
        require_count("n_restarts", self.n_restarts)
        require(0 < self.effort < math.inf, "effort", self.effort, "a number > 0")

    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return the best state of each restart, of the trials first; a single one where it is proven."""
        graph, enumerated = qubo.graph, qubo.n
        if isinstance(graph, Bipartite) and is_floating(qubo.linear):  # integers are enumerated as a whole
            enumerated = min(graph.n_first, graph.n_second)
        if enumerated <= MOST_ENUMERATED:
            return BruteForce(max_variables=MOST_ENUMERATED).minimise(qubo, generator=generator)
        qubo = without_zeros(qubo)
        if isinstance(qubo.graph, Bipartite):
            n_sweeps = self._of(default_sweeps(qubo))
            anneal, n_trial = GibbsAnnealing(n_sweeps=n_sweeps), max(1, self.n_restarts // 8)
            steps = min(MOST - 1, max(1, round(n_sweeps * qubo.n * STEPS_A_SWEEP)))
            return self._of_two(anneal, n_trial, TabuSearch(n_steps=steps), qubo, generator)
        crossover = CrossoverAnnealing(n_restarts=self.n_restarts)
        crossover = replace(crossover, n_sweeps=self._of(crossover.n_sweeps))
        if len(qubo.graph.edges()) < DENSE * qubo.n * (qubo.n - 1) / 2:
            return crossover.minimise(qubo, generator=generator)
        search = TabuSearch(n_steps=min(MOST - 1, self._of(100 * qubo.n)))
        return self._of_two(crossover, (self.n_restarts + 1) // 2, search, qubo, generator)

    def _of_two(
        self,
        anneal: "GibbsAnnealing | CrossoverAnnealing",
        n_trial: int,
        search: TabuSearch,
        qubo: Qubo,
        generator: "Generator",
    ) -> QuboSolution:
        """Trials of annealing and tabu search, then the better one; ``n_trial`` restarts of the first."""
        begin = time.perf_counter() - compiling.seconds_spent()
        n_searched = min(max(1, self.n_restarts // 8), self.n_restarts - n_trial)
        trials: list[QuboSolver] = [replace(anneal, n_restarts=n_trial)]
        if n_searched:
            trials.append(replace(search, n_restarts=n_searched))
        found = [solver.minimise(qubo, generator=generator) for solver in trials]
        energies = [float(solution.best_energy.sum()) for solution in found]
        agree = abs(energies[0] - energies[-1]) <= rounding(parts_of(qubo))
        n_left = self.n_restarts - n_trial - n_searched
        n_annealed = n_left // 2 if agree else n_left if energies[0] < energies[-1] else 0
        rest: list[QuboSolver] = []
        if n_annealed:
            rest.append(replace(anneal, n_restarts=n_annealed))
        if n_annealed < n_left:
            rest.append(replace(search, n_restarts=n_left - n_annealed))
        found += [solver.minimise(qubo, generator=generator) for solver in rest]
        return QuboSolution.joined(found, time.perf_counter() - compiling.seconds_spent() - begin)

    def _of(self, n: int) -> int:
        """So many sweeps, times the effort."""
        return max(1, round(self.effort * n))


DENSE = 0.25
"""Share of all pairs from which on tabu search may do better than crossover."""

STEPS_A_SWEEP = 0.02
"""Steps of a tabu search that take about as long as a sweep of annealing, a variable."""


def default_sweeps(qubo: Qubo) -> int:
    """Sweeps of a restart in two layers: as many as there are variables, from 30 to 1,000."""
    return min(1000, max(30, qubo.n))
