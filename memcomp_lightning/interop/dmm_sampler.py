"""The DMM as a ``dimod.Sampler``: for whoever has a binary quadratic model and dimod's tools."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from memcomp_lightning import rng
from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.optional import WITHOUT_DIMOD
from memcomp_lightning.solvers import QuboSolver, Status
from memcomp_lightning.solvers.dmm import DmmSolver

try:
    import dimod
    from dimod import SampleSet

    from memcomp_lightning.problems.bqm import from_bqm
except ModuleNotFoundError:
    raise ModuleNotFoundError(WITHOUT_DIMOD) from None


class DmmDimodSampler(dimod.Sampler):  # type: ignore[misc,name-defined]
    """Answers binary quadratic models of either vartype with the restarts of a solver.

    Args:
        solver: The solver; None is :class:`DmmSolver` with its defaults.

    >>> answer = DmmDimodSampler().sample(dimod.BQM({"a": 1}, {("a", "b"): -3}, 0.0, "SPIN"), num_reads=3, seed=0)
    >>> float(answer.first.energy), len(answer)
    (-4.0, 3)
    """

    def __init__(self, solver: QuboSolver | None = None) -> None:
        self.solver = DmmSolver() if solver is None else solver

    @property
    def parameters(self) -> dict[str, list[str]]:
        """Keyword arguments of :meth:`sample`."""
        return {"num_reads": [], "seed": []}

    @property
    def properties(self) -> dict[str, str]:
        """The solver with its settings."""
        return {"solver": repr(self.solver)}

    def sample(
        self,
        bqm: dimod.BinaryQuadraticModel,
        *,
        num_reads: int | None = None,
        seed: int | None = None,
        **given: object,
    ) -> SampleSet:
        """Return a SampleSet, one sample a restart, those that were not run left out.

        Args:
            bqm: The model.
            num_reads: Restarts; None is the solver's own number.
            seed: Of the random stream; None takes 0.
            given: Anything else is reported by a warning, as dimod's samplers do.
        """
        self.remove_unknown_kwargs(**given)
        sample_set: Callable[..., SampleSet] = SampleSet.from_samples_bqm
        if not bqm.num_variables:
            return sample_set([], bqm)
        solver: Any = self.solver
        if num_reads is not None:
            if not hasattr(solver, "n_restarts"):
                raise ValueError(f"num_reads = {num_reads}: {type(solver).__name__} has no n_restarts to set.")
            solver = dataclasses.replace(solver, n_restarts=num_reads)
        problem, variables = from_bqm(bqm)
        solution = solver.minimise(problem, generator=rng.numpy_stream(0 if seed is None else seed, "solver"))
        was_run = solution.status != int(Status.NOT_RUN)
        x = to_numpy(solution.assignments)[to_numpy(was_run)].astype(np.int8)
        if bqm.vartype is dimod.SPIN:
            x = 2 * x - 1
        info = {"wall_time_s": solution.wall_time_s, "messages": solution.messages()}
        return sample_set((np.ascontiguousarray(x), variables), bqm, info=info)
