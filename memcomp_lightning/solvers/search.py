"""Solve one problem until time is up, a target is met, or the answer is proven."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, is_dataclass, replace
from fractions import Fraction
from numbers import Real

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning import compiling, rng
from memcomp_lightning.arrays import alike, as_array, cast, double, is_floating, to_numpy
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.problems.constrained import Constrained
from memcomp_lightning.problems.files.numbers import Exact
from memcomp_lightning.problems.maxsat import WeightedMaxSat, as_qubo
from memcomp_lightning.problems.problem import Problem
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.answer import in_full_of
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver, RecordedStates, Status
from memcomp_lightning.solvers.best import MOST_ENUMERATED, Portfolio
from memcomp_lightning.solvers.compiled import limited
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.solvers.found import PROVEN, Found, State
from memcomp_lightning.solvers.proofs import RoofDual, eliminated, parts_of, roof_dual, rounding
from memcomp_lightning.solvers.solving import Given, constrained_of, minimise, numbers_of
from memcomp_lightning.solvers.tabu import MOST, TabuSearch

Bits = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, slots=True)
class Search:
    """Solve one problem in rounds: the first is the solver's own call, each later one takes up to twice as long.

    Without a time limit and a target there is one round, and the same seed gives the same answer. A proof ends the
    search. Ctrl-C ends it, too: what was found by then is returned. With a ``Portfolio`` what can be proven at
    once is: graphs of treewidth two, and what roof duality decides.

    Attributes:
        time_limit: Seconds, > 0, those of compilation not counted; None is no limit. Annealing, crossover and tabu
            search end in time; other solvers end the round that they are in.
        target: The search ends at this energy or below; None is no target.
        n_solutions: Most distinct states to keep, >= 1. Where restarts find fewer, short tabu searches add theirs.
        min_distance: Number of variables in which any two of these states differ at least, >= 1.
    """

    time_limit: float | None = None
    target: float | None = None
    n_solutions: int = 1
    min_distance: int = 1

    def __post_init__(self) -> None:
        for name in ("time_limit", "target"):
            value = getattr(self, name)
            number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
            valid = number and (name == "target" or value > 0)
            allowed = {"time_limit": "seconds > 0, or None", "target": "a finite number, or None"}[name]
            require(value is None or valid, name, value, allowed)
        require_count("n_solutions", self.n_solutions)
        require_count("min_distance", self.min_distance)

    def run(
        self,
        problem: Given,
        solver: QuboSolver,
        *,
        seed: int = 0,
        initial: Bits | None = None,
        callback: Callable[[State], object] | None = None,
    ) -> Found:
        """Look for the minimum.

        Args:
            problem: One problem.
            solver: Any solver; restarts that agree say something only if they are independent.
            seed: Of the random stream.
            initial: States to begin with, ``(n_states, n)``; None is none.
            callback: Called with each state that is lower than all before.
        """
        given = numbers_of(problem)
        require(given.problems == (), "problems", given.problems, "one problem, without leading axes")
        record, generator = _Record(self, problem, callback), rng.numpy_stream(seed, "solver")
        try:
            if initial is not None:
                record.offer(initial)
            if initial is not None and not record.settled:
                record.improve(initial, rng.numpy_stream(seed, "initial states"))
            self._rounds(record, solver, generator)
        except KeyboardInterrupt:
            if not record.states:
                raise
            return replace(record.found(), interrupted=True)
        return record.found()

    def _rounds(self, record: "_Record", solver: QuboSolver, generator: np.random.Generator) -> None:
        """Solve, and tell the record."""
        if isinstance(solver, Portfolio):
            record.prove()
        one_call = self.time_limit is None and self.target is None
        while not record.settled or self.n_solutions > 1:
            begin = record.seconds
            solution = record.solve(solver, generator)
            if not record.settled:
                record.bound()
            left, took = record.left, max(record.seconds - begin, 1e-9)
            if one_call or record.settled or left < _WORTH * took:
                break
            solver = _longer(solver, min(2.0, left / took), int(solution.steps.max()))
        if len(record.states) < self.n_solutions:
            record.fill(generator)


_WORTH = 0.1
"""Share of the last round's time that must be left for another one."""

_LENGTHS = ("effort", "n_sweeps", "n_steps", "max_steps", "max_nodes")
"""Settings that say how long a restart takes; a solver has at most one of them."""


def _longer(solver: QuboSolver, factor: float, steps: int) -> QuboSolver:
    """The solver with restarts that take ``factor`` times as long, if it has a setting for that.

    Args:
        solver: The solver of the last round.
        factor: > 0.
        steps: The length of the last round's restarts, for a setting that is None.
    """
    name = next((name for name in _LENGTHS if hasattr(solver, name)), None)
    if name is None or not is_dataclass(solver):
        return solver
    value = getattr(solver, name)
    length = factor * (steps if value is None else value)
    settings = {name: length if isinstance(value, float) else min(max(1, round(length)), MOST - 1)}
    if isinstance(solver, DmmSolver):
        settings["record"] = None  # the first round's is drawn
    return replace(solver, **settings)


class _Record:
    """What a search has found so far."""

    def __init__(self, search: Search, problem: Given, callback: Callable[[State], object] | None) -> None:
        self._begin = time.perf_counter() - compiling.seconds_spent()
        self._search, self._problem, self._callback = search, problem, callback
        self._given = given = numbers_of(problem)
        self._qubo = None if isinstance(given, WeightedMaxSat) and given.longer else as_qubo(given)
        self._unit = unit_of(problem)
        self._noise = 10 * rounding(parts_of(given)) if self._unit is None else 0
        self._resolution = 0.75 * self._unit if self._unit else self._noise
        self._curve, self._lower_bound = list[tuple[float, Exact | float]](), -math.inf
        self._energies, self._status, self._steps = list[Exact | float | None](), list[Status](), list[int]()
        self._broken, self._population = list[int](), list[int]()
        self._trajectory: RecordedStates | None = None
        self._last: QuboSolution | None = None
        self.states: list[State] = []

    @property
    def seconds(self) -> float:
        """Since the search began."""
        return time.perf_counter() - compiling.seconds_spent() - self._begin

    @property
    def left(self) -> float:
        """Seconds that are left for rounds: if several states are asked for, a tenth is kept for :meth:`fill`."""
        limit = self._search.time_limit or math.inf
        return limit * (1.0 if self._search.n_solutions == 1 else 0.9) - self.seconds

    @contextmanager
    def _within(self, seconds: float) -> Iterator[None]:
        """Searches in here end in time; Ctrl-C comes up after what they return is taken in."""
        with limited(time.perf_counter() + seconds) as limit:
            yield
        if limit.interrupted:
            raise KeyboardInterrupt

    @property
    def settled(self) -> bool:
        """Whether the best state is proven, or meets the target."""
        return bool(self.states) and (self._meets_target() or self.found().conclusion in PROVEN)

    def found(self) -> Found:
        """What was found by now."""
        found = Found(
            states=[state for state in self.states if not state.n_broken] or self.states[:1],
            curve=self._curve,
            energies=self._energies,
            broken=self._broken,
            status=self._status,
            steps=self._steps,
            population=self._population,
            lower_bound=self._lower_bound,
            resolution=self._resolution,
            wall_time_s=self.seconds,
            last=self._last,
            trajectory=self._trajectory,
        )
        proven = found.conclusion is Status.OPTIMAL
        return replace(found, lower_bound=_at_most(found.states[0].energy)) if proven else found

    def solve(self, solver: QuboSolver, generator: np.random.Generator) -> QuboSolution:
        """A round."""
        with self._within(self.left):
            solution = minimise(self._problem, solver, generator)
            self.add(solution)
            if not self.states:  # the time was up before any restart began
                self.offer(np.zeros((1, self._given.n), np.bool_))
        return solution

    def add(self, solution: QuboSolution) -> None:
        """Take in what a round has found."""
        energies: list[Exact | float | None]
        if isinstance(self._problem, Problem):
            energies, broken, status = in_full_of(self._problem, solution)
        else:
            energies = self._exact(solution)
            broken = [0] * len(energies) if solution.broken is None else solution.broken.tolist()
            status = [Status(code) for code in solution.status.tolist()]
        self._energies += energies
        self._broken += broken
        self._status += status
        self._steps += solution.steps.tolist()
        number = range(len(status)) if solution.population is None else solution.population.tolist()
        first = 1 + max(self._population, default=-1)
        self._population += [first + k for k in number]
        self._trajectory, self._last = self._trajectory or solution.trajectory, solution
        x = to_numpy(solution.assignments) > 0.5
        each = enumerate(zip(energies, broken, strict=True))
        self._offer([(n_broken, energy, x[k]) for k, (energy, n_broken) in each if energy is not None])

    def _exact(self, solution: QuboSolution) -> list[Exact | float | None]:
        """Energy of each restart, None where not run; of whole numbers that are kept as such without rounding."""
        energies = solution.energies
        if not is_floating(self._given.offset):
            states = cast(alike(solution.assignments, self._given.offset), self._given.offset.dtype)
            energies = self._given.energy(states)
        run = np.isfinite(to_numpy(solution.energies)).tolist()
        return [energy if ran else None for energy, ran in zip(energies.tolist(), run, strict=True)]

    def offer(self, x: Bits) -> None:
        """Keep those of these states ``(n_states, n)`` that are low enough, and tell of each better one."""
        problem, like = self._problem, self._given.offset
        if isinstance(problem, Problem):
            scores = [problem.score(as_array(row)) for row in x]
            energies = [problem.objective.energy(score) for score in scores]
            broken = [score.hard_unsatisfied for score in scores]
        else:
            states = cast(alike(x, like), like.dtype)
            energies = self._given.energy(states).tolist()
            broken = problem.n_broken(states).tolist() if isinstance(problem, Constrained) else [0] * len(x)
        self._offer(list(zip(broken, energies, x, strict=True)))

    def _offer(self, ranked: list[tuple[int, Exact | float, Bits]]) -> None:
        """Take numbers of broken constraints, energies and states."""
        most, distance = self._search.n_solutions, self._search.min_distance
        for n_broken, energy, x in sorted(ranked, key=lambda found: found[:2]):
            states, rank = self.states, (n_broken, energy)
            if len(states) == most and rank >= _rank(states[-1]):
                return
            close = [state for state in states if int((state.values != x).sum()) < distance]
            if any(_rank(state) <= (n_broken, energy + self._noise) for state in close):
                continue
            state, nearby = State(x, energy, self.seconds, n_broken), [id(other) for other in close]
            apart = [other for other in states if id(other) not in nearby]
            self.states = sorted([*apart, state], key=_rank)[:most]
            if not n_broken and (not self._curve or energy < self._curve[-1][1] - self._noise):
                self._curve.append((state.seconds, energy))
                if self._callback is not None:
                    self._callback(state)

    def improve(self, x: Bits, generator: np.random.Generator) -> None:
        """Offer what short tabu searches find from these states, if the problem is as plain as they are."""
        if self._qubo is not None and self._qubo.n and constrained_of(self._problem) is None:
            start = cast(alike(x, self._qubo.linear), self._qubo.linear.dtype)
            solver = TabuSearch(n_restarts=len(x), n_steps=max(10, self._qubo.n))
            with self._within(self.left):
                found = solver.minimise(self._qubo, start=start, generator=generator)
                self.offer(to_numpy(found.assignments) > 0.5)

    def prove(self) -> None:
        """Look for a proof that takes little time, and else for a lower bound."""
        if self._qubo is None or not self._qubo.n or isinstance(self._problem, Constrained):
            return
        minimum = eliminated(self._qubo)
        if minimum is None and (dual := self.bound()) is not None:
            minimum = dual.minimum
        if minimum is not None:
            self.add(_proven(self._qubo, minimum))

    def bound(self) -> RoofDual | None:
        """Look for a lower bound, unless there is one, or the problem is small enough to be enumerated."""
        if self._qubo is None or self._qubo.n <= MOST_ENUMERATED or self._lower_bound > -math.inf:
            return None
        dual = roof_dual(self._qubo)
        if dual is not None:
            self._lower_bound = math.ceil(dual.lower_bound) if self._unit == 1 else dual.lower_bound
        return dual

    def fill(self, generator: np.random.Generator) -> None:
        """Offer all states of a small problem, or else what short searches find."""
        if 0 < self._given.n <= MOST_ENUMERATED:
            self.offer(to_numpy(binary_states(self._given.n, like=as_array(np.zeros(0)))) > 0.5)
        else:
            for share in _SHORT:
                n_restarts, n_steps = 2 * self._search.n_solutions, math.ceil(share * self._given.n)
                with self._within((self._search.time_limit or math.inf) - self.seconds):
                    short = TabuSearch(n_restarts=n_restarts, n_steps=n_steps)
                    self.offer(to_numpy(minimise(self._problem, short, generator).assignments) > 0.5)

    def _meets_target(self) -> bool:
        target, energy = self._search.target, self.states[0].energy
        if target is None or self.states[0].n_broken:
            return False
        if isinstance(energy, int | Fraction):
            return energy <= Fraction(str(target))
        return energy <= target + self._noise


_SHORT = (0.25, 0.5, 1)
"""Flips of a variable in short searches: the shorter they are, the more minima they end in."""


def _at_most(energy: Exact | float) -> float:
    """The largest float that is not above it."""
    rounded = float(energy)
    return rounded if rounded <= energy else math.nextafter(rounded, -math.inf)


def _rank(state: State) -> tuple[int, Exact | float]:
    """What orders states."""
    return state.n_broken, state.energy


def _proven(qubo: Qubo, minimum: Bits) -> QuboSolution:
    """A solution of one restart."""
    x = cast(alike(minimum[None], qubo.linear), qubo.linear.dtype)
    ended = Status.ROUNDED if bool(qubo.rounds()) else Status.OPTIMAL
    status, steps = (alike(np.array([number]), x) for number in (int(ended), qubo.n))
    return QuboSolution(x, double(qubo.energy(x)), status, steps, wall_time_s=0.0)


def unit_of(problem: Given) -> float | None:
    """What all energies of a problem are multiples of: a step of the last digit; None where that is not known."""
    if isinstance(problem, Problem):
        return problem.objective.counting.unit
    whole = all(bool((part == part.round()).all()) for part in parts_of(numbers_of(problem)))
    return 1.0 if whole else None
