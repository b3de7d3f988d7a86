"""The digital memcomputing machine as a solver of QUBO and weighted MAX-SAT."""

import dataclasses
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from memcomp_lightning import compiling, rng
from memcomp_lightning.arrays import Array, cast, double, namespace
from memcomp_lightning.errors import require, require_count, require_parts
from memcomp_lightning.problems.graph import Bipartite
from memcomp_lightning.problems.maxsat import WeightedMaxSat, from_qubo
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, Status
from memcomp_lightning.solvers.compiled import check_kernel, device_of, obstacle, without_zeros
from memcomp_lightning.solvers.dmm.base import Recording, VectorField
from memcomp_lightning.solvers.dmm.clause import ClauseField
from memcomp_lightning.solvers.dmm.integrate import Integrator, Splitting
from memcomp_lightning.solvers.dmm.kernels import reference
from memcomp_lightning.solvers.dmm.kernels.run import Run, Stall, Start
from memcomp_lightning.solvers.dmm.trajectory import Trajectory

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True, slots=True)
class WarmRestart:
    """Let a group of restarts go on from where the group before it ended, instead of from random voltages.

    Attributes:
        keep: Share of the long-term memory that is kept, in [0, 1].
        spread: Bound of the uniform kick on the final voltages, in (0, 2].
    """

    keep: float = 0.5
    spread: float = 0.5

    def __post_init__(self) -> None:
        require(0 <= self.keep <= 1, "keep", self.keep, "a number in [0, 1]")
        require(0 < self.spread <= 2, "spread", self.spread, "a number in (0, 2]")


@dataclass(frozen=True, kw_only=True, slots=True)
class DmmSolver:
    """Solve QUBO and weighted MAX-SAT by integrating a DMM, and keep the best assignment met.

    QUBO -> weighted MAX-SAT -> ODE -> assignment (Manukian et al. 2019, Fig. 3). Restarts run side by side,
    ``patience`` of them at a time. After each such group the paper's rule is checked: stop once ``patience``
    restarts have passed without a better assignment.

    Attributes:
        field: The vector field.
        integrator: The scheme of one step; None takes the one that the field's constants were chosen with.
        n_restarts: Most restarts a problem, >= 1 (the paper: 28).
        patience: Restarts without a better assignment after which a problem is done, 1 to n_restarts; None
            runs all restarts at once.
        max_steps: Most integration steps a restart, >= 1; None takes :func:`default_steps` of the problem.
        stall: Factor > 0: a restart whose best assignment came at step k ends early, after
            :func:`default_min_steps` plus ``stall`` times k steps. With None, and while recording, every restart
            runs for ``max_steps``.
        quench_every: Steps from one reading of the bits to the next. A copy of the bits then descends by single
            flips, without any effect on the machine. 0 reads at every step, without a descent. None takes
            :func:`default_quench` of the problem.
        warm: How later groups begin; None draws new voltages with memories at rest.
        record: Records trajectories, for the time average and for plots; None does not.
        kernel: "compiled" for the CPU; "reference", plain operations on arrays, for any device, field and
            integrator; "cuda" for a CUDA device, wherever the problem lies; or "auto": compiled where it can be on
            the CPU, else plain.

    >>> import numpy as np
    >>> qubo = Qubo.from_matrix(np.array([[1.0, -3.0], [0.0, 1.0]]))
    >>> DmmSolver(max_steps=50).minimise(qubo, generator=np.random.default_rng(0)).best_energy.item()
    -1.0
    """

    field: VectorField[Any, Any] = dataclasses.field(default_factory=ClauseField)
    integrator: Integrator | None = None
    n_restarts: int = 28
    patience: int | None = None
    max_steps: int | None = None
    stall: float | None = 2.0
    quench_every: int | None = None
    warm: WarmRestart | None = None
    record: Recording | None = None
    kernel: Literal["auto", "compiled", "reference", "cuda"] = "auto"

    def __post_init__(self) -> None:
        parts = ("integrator", "noise", "spread", "build", "stability", "init", "derivative", "bound")
        require_parts("field", self.field, "vector field", parts)
        if self.integrator is not None:
            require_parts("integrator", self.integrator, "integrator", ("step",))
        require_count("n_restarts", self.n_restarts)
        for name, smallest in (("max_steps", 1), ("patience", 1), ("quench_every", 0)):
            if getattr(self, name) is not None:
                require_count(name, getattr(self, name), smallest)
        if self.stall is not None:
            require(0 < self.stall < math.inf, "stall", self.stall, "a number > 0, or null")
        if self.patience is not None:
            require(
                self.patience <= self.n_restarts,
                "patience",
                self.patience,
                f"an integer from 1 to n_restarts = {self.n_restarts}, or null",
            )
        if self.warm is not None:
            require_parts("warm", self.warm, "WarmRestart", ("keep", "spread"))
            require(
                self.patience is not None and self.n_restarts % self.patience == 0,
                "warm",
                self.warm,
                f"null, or a patience that divides n_restarts = {self.n_restarts}",
                f"Set patience (now {self.patience}), the number of restarts that each later group goes on from.",
            )
        if self.record is not None:
            require_parts("record", self.record, "Recording", ("every",))
            require_count("record.every", self.record.every)
            if self.max_steps is not None:
                require(
                    self.record.every <= self.max_steps,
                    "record.every",
                    self.record.every,
                    f"an integer from 1 to max_steps = {self.max_steps}",
                )
        obstacles = {"compiled": lambda: self._obstacle("cpu"), "cuda": self._cuda_obstacle}
        check_kernel(self.kernel, obstacles.get(self.kernel, lambda: None)(), ("cuda",))

    @np.errstate(under="ignore")
    def minimise(self, problem: Qubo | WeightedMaxSat, *, generator: "Generator") -> QuboSolution:
        """Return the best assignment of each restart.

        Args:
            problem: One or many problems of one shape, ``(*problems, ...)``.
            generator: For the initial voltages and the noise, of numpy or torch.
        """
        begin = time.perf_counter() - compiling.seconds_spent()
        if isinstance(problem, Qubo):
            problem = without_zeros(problem.floating())
        flat = _flatten(problem)
        n_problems, device, xp = flat.offset.shape[0], flat.offset.device, namespace(flat.offset)
        n_steps = self.max_steps or default_steps(flat)
        group_size = self.patience or self.n_restarts
        parts, shape = list[_Part](), (n_problems, self.n_restarts)
        active = xp.arange(n_problems, device=device)
        lowest = xp.full((n_problems,), xp.inf, dtype=xp.float64, device=device)
        lowest_at = xp.zeros_like(active)
        before: Run | None = None
        for done in range(0, self.n_restarts, group_size):
            group = slice(done, min(done + group_size, self.n_restarts))
            part = flat if len(active) == n_problems else _select(flat, active)
            start = self._start(part, group.stop - group.start, before, generator)
            run = self._run(part, start, n_steps)
            energies = part.energy(run.best)
            visited = self.record and run.visited and _trajectory(part, run, energies, self.record.every)
            parts.append(_Part(active, group, run, energies, visited))
            if group.stop == self.n_restarts:
                break
            found, at = xp.min(energies, axis=-1), energies.argmin(-1)
            lowest_at[active] = xp.where(found < lowest[active], done + at, lowest_at[active])
            lowest[active] = xp.minimum(found, lowest[active])
            going_on = group.stop - 1 - lowest_at[active] < group_size
            active = active[going_on]
            if not len(active):
                break
            if self.warm is not None:
                before = run._replace(voltage=run.voltage[going_on], kept=tuple(m[going_on] for m in run.kept))

        def whole(pick: Callable[[_Part], Array], elsewhere: float = 0) -> Array:
            joined = _join([(part.problems, part.restarts, pick(part)) for part in parts], shape, elsewhere)
            return joined.reshape(*problem.problems, *joined.shape[1:])

        steps, found_at = whole(lambda part: part.run.steps), whole(lambda part: part.run.found_at)
        status = xp.where(steps < n_steps, int(Status.STALLED), int(Status.STEP_BUDGET))
        status = xp.where(found_at > 0.9 * n_steps, int(Status.STILL_IMPROVING), status)
        energies = whole(lambda part: part.energies, xp.inf)
        trajectory = None
        if self.record is not None and parts[0].visited is not None:
            columns = range(len(Trajectory._fields))
            trajectory = Trajectory(*(whole(lambda part, k=k: part.visited[k]) for k in columns))  # type: ignore[misc]
        return QuboSolution(
            assignments=cast(whole(lambda part: part.run.best), start.voltage.dtype),
            energies=energies,
            status=xp.where(energies == xp.inf, int(Status.NOT_RUN), status),
            steps=steps,
            wall_time_s=time.perf_counter() - compiling.seconds_spent() - begin,
            trajectory=trajectory,
        )

    @property
    def takes_clauses(self) -> bool:
        """Whether clauses of any length need not become a QUBO first."""
        return getattr(self.field, "takes_long_clauses", True)

    def _start(
        self, problem: Qubo | WeightedMaxSat, n_restarts: int, before: Run | None, generator: "Generator"
    ) -> Start:
        """New voltages with memories at rest, or a kick to where the last restarts ended."""
        like = problem.linear if isinstance(problem, Qubo) else problem.unit
        shape = (problem.offset.shape[0], n_restarts)
        kick = 2 * rng.uniform((*shape, problem.n), generator=generator, like=like) - 1
        seed = rng.integers(2**32, shape, generator=generator, like=like)
        if self.warm is None or before is None:
            return Start(self.field.spread * kick, (), seed)
        voltage = (cast(before.voltage, like.dtype) + self.warm.spread * kick).clip(-1, 1)
        return Start(voltage, tuple(self.warm.keep * memory for memory in before.kept), seed)

    def _run(self, problem: Qubo | WeightedMaxSat, start: Start, n_steps: int) -> Run:
        """Run the kernel that the settings ask for."""
        integrator = self.integrator or self.field.integrator
        obstacle = self._obstacle(device_of(start.voltage)) if self.kernel in ("auto", "compiled") else None
        kernel: Callable[..., Run] = reference.run
        if obstacle is not None:
            _say_once(obstacle)
        elif self.kernel == "cuda":
            from memcomp_lightning.solvers.dmm.kernels import cuda

            kernel = cuda.run
        elif self.kernel != "reference":
            from memcomp_lightning.solvers.dmm.kernels import cpu

            kernel = cpu.run
        return kernel(
            self.field,
            integrator,
            problem,
            start,
            n_steps=n_steps,
            quench_every=default_quench(problem) if self.quench_every is None else self.quench_every,
            recording=self.record,
            stall=None if self.stall is None else Stall(default_min_steps(problem), self.stall),
            remember=self.warm is not None,
        )

    def _obstacle(self, device: str) -> str | None:
        """Why the compiled kernel cannot run, and what to do; None if it can."""
        integrator = self.integrator or self.field.integrator
        if (reason := obstacle(device)) is not None:
            return reason
        from memcomp_lightning.solvers.dmm.kernels.fields import FIELDS

        if type(self.field) not in FIELDS:
            return f"{type(self.field).__name__} has no compiled kernel: the plain kernel integrates it."
        if type(integrator) is not Splitting:
            return f"{type(integrator).__name__} has no compiled kernel: use Splitting for speed."
        return FIELDS[type(self.field)].obstacle(self.field)

    def _cuda_obstacle(self) -> str | None:
        """Why the kernel for CUDA devices cannot run, and what to do; None if it can."""
        if (reason := obstacle("cpu")) is not None:
            return reason
        from memcomp_lightning.solvers.dmm.kernels import cuda

        return cuda.obstacle(self.field, self.integrator or self.field.integrator)


class _Part(NamedTuple):
    """A group of restarts of the problems that were not done by then."""

    problems: Array
    restarts: slice
    run: Run
    energies: Array
    visited: Trajectory | None


def default_steps(problem: Qubo | WeightedMaxSat) -> int:
    """Default of ``max_steps``: 3 n up to n = 200 variables, then ``600 (n / 200)^(1/4)``; at least 50."""
    return max(50, round(min(3 * problem.n, 600 * math.pow(problem.n / 200, 0.25))))


def default_min_steps(problem: Qubo | WeightedMaxSat) -> int:
    """Steps that each restart gets before it may stall: a fifteenth of :func:`default_steps`, at least 10."""
    return max(10, default_steps(problem) // 15)


def default_quench(problem: Qubo | WeightedMaxSat) -> int:
    """Default of ``quench_every``: 1 for two fully coupled layers, else ``6 n / n_pairs``, at least 2.

    The cost of a step grows with the pairs, that of a descent with the variables: where pairs are few, so are
    readings.
    """
    if isinstance(problem.graph, Bipartite):
        return 1
    n_pairs = math.prod(problem.graph.edge_shape)
    n_pairs += 0 if isinstance(problem, Qubo) else sum(len(block.variables) for block in problem.longer)
    return max(2, round(6 * problem.n / max(n_pairs, 1)))


@cache
def _say_once(message: str) -> None:
    log.info(message)


def _map(problem: Qubo | WeightedMaxSat, change: Callable[[Array], Array]) -> Qubo | WeightedMaxSat:
    """Apply a change of the axes of problems to all tensors that have them."""
    if isinstance(problem, Qubo):
        return dataclasses.replace(
            problem,
            coupling=change(problem.coupling),
            linear=change(problem.linear),
            offset=change(problem.offset),
        )
    return dataclasses.replace(
        problem,
        weight=change(problem.weight),
        first=change(namespace(problem.weight).broadcast_to(problem.first, problem.weight.shape)),
        second=change(namespace(problem.weight).broadcast_to(problem.second, problem.weight.shape)),
        unit=change(problem.unit),
        offset=change(problem.offset),
        longer=tuple(dataclasses.replace(block, weight=change(block.weight)) for block in problem.longer),
    )


def _flatten(problem: Qubo | WeightedMaxSat) -> Qubo | WeightedMaxSat:
    """All problems on one leading axis."""
    n_problems, axes = math.prod(problem.problems), len(problem.problems)
    if axes == 1:
        return problem
    return _map(problem, lambda x: x.reshape(n_problems, *x.shape[axes:]))


def _select(problem: Qubo | WeightedMaxSat, chosen: Array) -> Qubo | WeightedMaxSat:
    """Some of the problems on the leading axis."""
    return _map(problem, lambda x: x[chosen])


def _trajectory(problem: Qubo | WeightedMaxSat, run: Run, lowest: Array, every: int) -> Trajectory:
    """Add what the records and the best assignments weigh, in float64, and how long each record stands.

    ``lowest`` are the energies of the best assignments; ``every`` is the number of steps between records.
    """
    assert run.visited is not None
    times, states = run.visited
    n_problems, n_restarts = times.shape[:2]
    n_terms = math.prod(problem.graph.edge_shape) + problem.n
    if isinstance(problem, WeightedMaxSat):
        n_terms += sum(math.prod(block.variables.shape) for block in problem.longer)
    # All records at once could need memory for records x terms.
    block = max(1, _MOST_TERMS // (n_problems * n_restarts * n_terms))
    xp, parts = namespace(times), []
    for begin in range(0, states.shape[2], block):
        part = states[:, :, begin : begin + block]
        energies = problem.energy(part.reshape(n_problems, -1, part.shape[-1]))
        parts.append(energies.reshape(part.shape[:-1]))
    offset = from_qubo(problem).offset if isinstance(problem, Qubo) else double(problem.offset)
    dwell = xp.concat((times[..., :1], times[..., 1:] - times[..., :-1]), axis=-1)
    steps = every * xp.arange(1, times.shape[-1] + 1, device=times.device)
    last = steps == every * times.shape[-1]  # what is found after it counts there
    found = xp.where((run.found_at[..., None] <= steps) | last, (lowest - offset[:, None])[..., None], xp.inf)
    return Trajectory(times, xp.concat(parts, axis=-1) - offset[:, None, None], states, dwell, found)


_MOST_TERMS = 2**22
"""Terms of energies that are held at once: 32 MiB in float64."""


def _join(parts: list[tuple[Array, slice, Array]], shape: tuple[int, int], elsewhere: float) -> Array:
    """What all groups returned, ``(n_problems, n_restarts, ...)``; ``elsewhere`` where no restart was run."""
    first = parts[0][2]
    if first.shape[:2] == shape:
        return first
    xp = namespace(first)
    joined = xp.full((*shape, *first.shape[2:]), elsewhere, dtype=first.dtype, device=first.device)
    for problems, restarts, values in parts:
        joined[problems, restarts] = values
    return joined
