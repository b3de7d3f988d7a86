"""The digital memcomputing machine as a QUBO solver: restarts, stopping rule, readout."""

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from memcomp_lightning.dmm.base import Recording, VectorField
from memcomp_lightning.dmm.clause import ClauseField
from memcomp_lightning.dmm.integrate import AdaptiveEuler, Integrator
from memcomp_lightning.dmm.kernels import reference
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.qubo.maxsat import from_qubo
from memcomp_lightning.qubo.qubo import Qubo, QuboSolution, Status, Trajectory


@dataclass(frozen=True, kw_only=True, slots=True)
class DmmSolver:
    """Integrate a memory dynamics from random initial conditions and keep the best assignment met.

    QUBO -> weighted MAX-SAT -> ODE -> assignment (Manukian et al. 2019, Fig. 3). Restarts run side by side
    in one tensor program, ``patience`` of them at a time; the rule is the paper's, checked after each such
    group: stop once ``patience`` restarts have passed without a better assignment.

    Attributes:
        field: The vector field.
        integrator: The scheme of one step.
        n_restarts: Most restarts a problem, >= 1 (the paper: 28).
        patience: Restarts without a better assignment after which a problem is done, 1 to n_restarts; None
            runs all restarts at once.
        max_steps: Integration steps a restart, >= 1.
        record: Records trajectories, for the time average and for plots; None does not.

    >>> from memcomp_lightning import rng
    >>> qubo = Qubo.from_matrix(torch.tensor([[1.0, -3.0], [0.0, 1.0]]))
    >>> DmmSolver(max_steps=50).minimise(qubo, generator=rng.stream(0, "solver")).best_energy.item()
    -1.0
    """

    field: VectorField[Any, Any] = dataclasses.field(default_factory=ClauseField)
    integrator: Integrator = dataclasses.field(default_factory=AdaptiveEuler)
    n_restarts: int = 28
    patience: int | None = None
    max_steps: int = 300
    record: Recording | None = None

    def __post_init__(self) -> None:
        require_count("n_restarts", self.n_restarts)
        require_count("max_steps", self.max_steps)
        if self.patience is not None:
            require_count("patience", self.patience)
            require(
                self.patience <= self.n_restarts,
                "patience",
                self.patience,
                f"an integer from 1 to n_restarts = {self.n_restarts}, or null",
            )
        if self.record is not None:
            require_count("record.every", self.record.every)
            require(
                self.record.every <= self.max_steps,
                "record.every",
                self.record.every,
                f"an integer from 1 to max_steps = {self.max_steps}",
            )

    def minimise(self, qubo: Qubo, *, generator: Generator) -> QuboSolution:
        """Return the best assignment of each restart."""
        begin = time.perf_counter()
        flat = _flatten(qubo)
        n_problems = flat.problems[0]
        device = flat.linear.device
        best = flat.linear.new_zeros(n_problems, self.n_restarts, qubo.n)
        found_at = torch.zeros(n_problems, self.n_restarts, dtype=torch.int64, device=device)
        was_run = torch.zeros(n_problems, self.n_restarts, dtype=torch.bool, device=device)
        trajectories: list[tuple[Tensor, slice, Trajectory]] = []
        active = torch.arange(n_problems, device=device)
        lowest = torch.full((n_problems,), torch.inf, dtype=torch.float64, device=device)
        lowest_at = torch.zeros(n_problems, dtype=torch.int64, device=device)
        done = 0
        while done < self.n_restarts and active.numel():
            group = slice(done, min(done + (self.patience or self.n_restarts), self.n_restarts))
            run = self._run(_select(flat, active), group.stop - group.start, generator)
            best[active, group] = run.best
            found_at[active, group] = run.found_at
            was_run[active, group] = True
            if run.trajectory is not None:
                trajectories.append((active, group, run.trajectory))
            done = group.stop
            if self.patience is not None:
                energy, index = _select(flat, active).energy(run.best).min(-1)
                better = energy < lowest[active]
                lowest_at[active] = torch.where(better, group.start + index, lowest_at[active])
                lowest[active] = torch.minimum(energy, lowest[active])
                active = active[done - 1 - lowest_at[active] < self.patience]
        energies = flat.energy(best).masked_fill(~was_run, torch.inf)
        status = torch.where(found_at > 0.9 * self.max_steps, Status.STILL_IMPROVING, Status.STEP_BUDGET)
        status = status.masked_fill(~was_run, Status.NOT_RUN)
        shape = (*qubo.problems, self.n_restarts)
        return QuboSolution(
            assignments=best.reshape(*shape, qubo.n),
            energies=energies.reshape(shape),
            status=status.reshape(shape),
            steps=(was_run * self.max_steps).reshape(shape),
            wall_time_s=time.perf_counter() - begin,
            trajectory=_join(trajectories, n_problems, self.n_restarts, qubo.problems),
        )

    def _run(self, qubo: Qubo, n_restarts: int, generator: Generator) -> reference.Run:
        maxsat = from_qubo(qubo)
        machine = self.field.build(maxsat)
        return reference.run(
            self.field,
            self.integrator,
            machine,
            self.field.init(machine, n_restarts, generator=generator),
            qubo,
            offset=maxsat.offset,
            n_steps=self.max_steps,
            recording=self.record,
        )


def _flatten(qubo: Qubo) -> Qubo:
    """All problems on one leading axis."""
    n_problems = math.prod(qubo.problems)
    return Qubo(
        graph=qubo.graph,
        coupling=qubo.coupling.reshape(n_problems, *qubo.graph.edge_shape),
        linear=qubo.linear.reshape(n_problems, qubo.n),
        offset=qubo.offset.reshape(-1),
    )


def _select(qubo: Qubo, problems: Tensor) -> Qubo:
    """Some of the problems on the leading axis."""
    return Qubo(
        graph=qubo.graph,
        coupling=qubo.coupling[problems],
        linear=qubo.linear[problems],
        offset=qubo.offset[problems],
    )


def _join(
    parts: list[tuple[Tensor, slice, Trajectory]], n_problems: int, n_restarts: int, problems: tuple[int, ...]
) -> Trajectory | None:
    """Trajectories of all groups of restarts; zeros where a restart was not run."""
    if not parts:
        return None
    columns: list[Tensor] = []
    for column in range(len(Trajectory._fields)):
        sample: Tensor = parts[0][2][column]
        joined = sample.new_zeros(n_problems, n_restarts, *sample.shape[2:])
        for active, group, trajectory in parts:
            joined[active, group] = trajectory[column]
        columns.append(joined.reshape(*problems, n_restarts, *sample.shape[2:]))
    return Trajectory(*columns)
