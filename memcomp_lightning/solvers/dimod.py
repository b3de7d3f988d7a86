"""Use any sampler of dimod as a solver: simulated annealing, a quantum annealer, D-Wave's hybrid service."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from memcomp_lightning import rng
from memcomp_lightning.arrays import Array, alike, cast, namespace
from memcomp_lightning.errors import SettingError, require, require_count
from memcomp_lightning.problems.bqm import to_bqm
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, Status

if TYPE_CHECKING:
    from memcomp_lightning.rng import Generator


@dataclass(frozen=True, kw_only=True, eq=False)
class DimodSolver:
    """Solve QUBOs with a ``dimod.Sampler``: one of dwave-samplers, a QPU within its composites, or LeapHybrid.

    Problems are solved one after the other. A sampler with a ``seed`` parameter gets one from the random stream.

    Attributes:
        sampler: The sampler; reads are restarts.
        parameters: Keyword arguments of its ``sample``: ``{"num_reads": 28, "num_sweeps": 100}``.
    """

    sampler: Any
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_parameters(self.sampler, self.parameters)

    def minimise(self, qubo: Qubo, *, generator: "Generator") -> QuboSolution:
        """Return every read of every problem; where one has fewer reads, the rest is marked as not run."""
        begin, xp = time.perf_counter(), namespace(qubo.linear)
        flat = [problem_at(qubo, index) for index in range(max(1, math.prod(qubo.problems)))]
        reads = [reads_of(sample_set(self.sampler, one, self.parameters, generator), one) for one in flat]
        n_reads = max(len(x) for x in reads)
        x = xp.stack([xp.concat((x, xp.broadcast_to(x[:1], (n_reads - len(x), qubo.n)))) for x in reads])
        x = x.reshape(*qubo.problems, n_reads, qubo.n)
        counts = alike(np.array([len(x) for x in reads]), x).reshape(*qubo.problems, 1)
        was_run = xp.arange(n_reads, device=x.device) < counts
        status = xp.where(was_run, int(Status.STEP_BUDGET), int(Status.NOT_RUN))
        energies = xp.where(was_run, qubo.energy(x), xp.inf)
        return QuboSolution(x, energies, status, cast(was_run, xp.int64), time.perf_counter() - begin)


def sample_set(sampler: Any, qubo: Qubo, parameters: Mapping[str, Any], generator: "Generator") -> Any:
    """The sample set of one problem.

    Raises:
        SettingError: The sampler does not take the parameters.
    """
    given = dict(parameters)
    if "seed" in sampler.parameters and "seed" not in given:
        given["seed"] = int(rng.integers(2**31, (), generator=generator, like=qubo.linear))
    try:
        return sampler.sample(to_bqm(qubo), **given)
    except (TypeError, ValueError) as error:
        kind = type(sampler).__name__
        raise SettingError(f"parameters = {dict(parameters)} does not suit {kind}.sample: {error}") from error


def reads_of(answer: Any, qubo: Qubo) -> Array:
    """Assignments of one problem, a row a read, ``(n_reads, n)``."""
    record, order = answer.record, np.array([int(variable) for variable in answer.variables], np.int64)
    rows = np.repeat(record.sample > 0, record.num_occurrences, axis=0)
    x = np.empty_like(rows)
    x[:, order] = rows
    return cast(alike(x, qubo.linear), qubo.linear.dtype)


def problem_at(qubo: Qubo, index: int) -> Qubo:
    """One of the problems."""
    n = max(1, math.prod(qubo.problems))
    coupling = qubo.coupling.reshape(n, *qubo.graph.edge_shape)[index]
    return Qubo(qubo.graph, coupling, qubo.linear.reshape(n, qubo.n)[index], qubo.offset.reshape(n)[index])


def check_parameters(sampler: Any, parameters: Mapping[str, Any]) -> None:
    """Refuse what is no sampler of dimod, and parameters that it does not take."""
    kind = type(sampler).__name__
    require(hasattr(sampler, "sample") and hasattr(sampler, "parameters"), "sampler", kind, "a dimod.Sampler")
    for name in parameters:
        known = sorted(sampler.parameters)
        require(name in known, f"parameter of {kind}", name, f"one of {', '.join(known)}")
    if "num_reads" in parameters:
        require_count("num_reads", parameters["num_reads"])
