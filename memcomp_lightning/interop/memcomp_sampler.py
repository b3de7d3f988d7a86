"""Our solvers as a ``dimod.Sampler``: for whoever has a binary quadratic model and dimod's tools."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.optional import WITHOUT_DIMOD
from memcomp_lightning.solvers import Portfolio, QuboSolver, Search, Status

try:
    import dimod
    from dimod import SampleSet

    from memcomp_lightning.problems.bqm import from_bqm
except ModuleNotFoundError:
    raise ModuleNotFoundError(WITHOUT_DIMOD) from None


class MemcompSampler(dimod.Sampler, dimod.Initialized):  # type: ignore[misc,name-defined]
    """Answers binary quadratic models of either vartype with the restarts of a solver.

    Args:
        solver: The solver; None is :class:`Portfolio` with its defaults.

    >>> answer = MemcompSampler().sample(dimod.BQM({"a": 1}, {("a", "b"): -3}, 0.0, "SPIN"))
    >>> float(answer.first.energy), answer.info["status"]
    (-4.0, 'OPTIMAL')
    """

    def __init__(self, solver: QuboSolver | None = None) -> None:
        self.solver = Portfolio() if solver is None else solver

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.solver!r})"

    @property
    def parameters(self) -> dict[str, list[str]]:
        """Keyword arguments of :meth:`sample`."""
        return {"num_reads": [], "seed": [], "time_limit": [], "initial_states": []}

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
        time_limit: float | None = None,
        initial_states: Any = None,
        **given: object,
    ) -> SampleSet:
        """Return a SampleSet, one sample a restart, those that were not run left out; a proven one counts for all.

        Args:
            bqm: The model.
            num_reads: Restarts; None is the solver's own number.
            seed: Of the random stream; None takes 0.
            time_limit: Seconds for longer and longer rounds; the samples are those of the last one, and the best
                of all. None is one call of the solver.
            initial_states: Samples to begin with, in any of dimod's forms; None is none.
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
        initial = None
        if initial_states is not None:
            parsed = self.parse_initial_states(bqm, initial_states, "none").initial_states
            initial = parsed.record.sample[:, [parsed.variables.index(label) for label in variables]] > 0
        search = Search(time_limit=time_limit)
        found = search.run(problem, solver, seed=0 if seed is None else seed, initial=initial)
        x, best = np.empty((0, len(variables)), np.bool_), found.states[0]
        if found.last is not None:
            was_run = to_numpy(found.last.status) != int(Status.NOT_RUN)
            x = to_numpy(found.last.assignments)[was_run] > 0.5
        if not (x == best.values).all(-1).any():
            x = np.concatenate((best.values[None], x))
        values = x.astype(np.int8)
        if bqm.vartype is dimod.SPIN:
            values = 2 * values - 1
        info = {
            "wall_time_s": found.wall_time_s,
            "status": found.conclusion.name,
            "lower_bound": found.lower_bound,
        }
        counts = [num_reads or 1] if len(x) == 1 else None
        return sample_set((np.ascontiguousarray(values), variables), bqm, info=info, num_occurrences=counts)
