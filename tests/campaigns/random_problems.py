"""Random problems with known minima through every solver.

    python tests/campaigns/random_problems.py --out FOLDER --count 100000

All numbers are whole, or whole multiples of 2^-10, so that every sum is exact in float64 and in Python's integers
alike: the minimum is that of a list of all states in integers, and what a solver reports is compared without any
tolerance. Held against each solver: no energy below the minimum, no energy that is not that of its state, no proof
of something else than the minimum, no lower bound above it, no broken constraint that is not said.
"""

import itertools
import sys
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import ledger
import networkx
import numpy as np
from numpy.typing import NDArray

from memcomp_lightning import rng, solve
from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Constrained, Linear, Qubo, WeightedMaxSat, clause
from memcomp_lightning.problems.graph import Bipartite
from memcomp_lightning.solvers import QuboSolver, Status
from memcomp_lightning.solvers.dmm import BondField, DmmSolver
from memcomp_lightning.solving import SOLVERS, solver_of

Integers = NDArray[np.int64]
AT_ONCE = 100
"""Problems of a case."""
RESTARTS = 4
SCALE = 2**10
PROVING = "brute_force", "branch_and_bound"
"""These prove a minimum, or refuse: more variables than may be enumerated, a graph that is not of two layers."""


def solvers() -> dict[str, QuboSolver]:
    """Every solver, with few restarts: an energy must be right whether or not it is the lowest."""
    found: dict[str, Any] = {name: solver_of(name) for name in SOLVERS}
    found = {
        name: replace(one, n_restarts=RESTARTS) if hasattr(one, "n_restarts") else one
        for name, one in found.items()
    }
    found["dmm_bond"] = DmmSolver(field=BondField(), n_restarts=RESTARTS)
    return found


def states(n: int) -> Integers:
    """All states of n bits, ``(2^n, n)``."""
    return np.array(list(itertools.product((0, 1), repeat=n)), dtype=np.int64).reshape(-1, n)


def energies(matrix: Integers, x: Integers) -> Integers:
    """x'Qx in whole numbers, ``(*problems, n_states)``."""
    return np.einsum("...si,...ij,...sj->...s", x, matrix, x)


# ------------------------------------------------------------------------------------------- many of one graph


@dataclass(frozen=True)
class Batch:
    """Problems of one graph, and the same in whole numbers.

    Attributes:
        qubo: What solvers are given.
        matrix: ``(problems, n, n)``; x'Qx is SCALE times the energy without the offset.
        offset: SCALE times that of the energy, ``(problems,)``.
    """

    qubo: Qubo
    matrix: Integers
    offset: Integers


def dense(random: np.random.Generator, dtype: type) -> Batch:
    n = int(random.integers(1, 11))
    matrix = _numbers(random, (AT_ONCE, n, n)) * (random.random((n, n)) < random.choice([0.3, 1.0]))
    offset = _numbers(random, (AT_ONCE,))
    return Batch(Qubo.from_matrix((matrix / SCALE).astype(dtype), (offset / SCALE).astype(dtype)), matrix, offset)


def two_layers(random: np.random.Generator, dtype: type) -> Batch:
    first, second = random.integers(1, 7, 2)
    n = first + second
    matrix = np.zeros((AT_ONCE, n, n), np.int64)
    coupling, linear = _numbers(random, (AT_ONCE, second, first)), _numbers(random, (AT_ONCE, n))
    matrix[:, first:, :first] = coupling
    matrix[:, range(n), range(n)] = linear
    offset = _numbers(random, (AT_ONCE,))
    parts = ((part / SCALE).astype(dtype) for part in (coupling, linear, offset))
    return Batch(Qubo(Bipartite(int(first), int(second)), *parts), matrix, offset)


def _numbers(random: np.random.Generator, shape: tuple[int, ...]) -> Integers:
    """Whole numbers of one of several sizes: few values make ties, many make none."""
    most = int(random.choice([1, 3, 100, SCALE * 10]))
    return random.integers(-most, most, shape, endpoint=True)


def check_batch(batch: Batch, name: str, solver: QuboSolver, seed: int) -> Iterator[str]:
    x = states(batch.qubo.n)
    lowest = energies(batch.matrix, x).min(-1) + batch.offset
    found = solver.minimise(batch.qubo, generator=rng.stream(seed, "solver"))
    answered, status = np.asarray(found.assignments), np.asarray(found.status)
    run = np.isfinite(np.asarray(found.energies))
    if not np.isin(answered, (0, 1)).all():
        yield f"{name}: a state that is not of 0 and 1"
        return
    exact = energies(batch.matrix, answered.astype(np.int64)) + batch.offset[:, None]
    reported = np.asarray(found.energies) * SCALE
    if (wrong := run & (reported != exact)).any():
        at = tuple(np.argwhere(wrong)[0])
        yield f"{name}: problem, restart {at}: {reported[at]} / {SCALE} reported, {exact[at]} in integers"
    if (run & (exact < lowest[:, None])).any():
        yield f"{name}: below the minimum: the list of states is wrong"
    if (proven := (status == Status.OPTIMAL) & (exact != lowest[:, None])).any():
        at = tuple(np.argwhere(proven)[0])
        yield f"{name}: problem and restart {at}: {exact[at]} is called proven, {lowest[at[0]]} is the minimum"
    if name in PROVING and (exact.min(-1) != lowest).any():
        yield f"{name}: misses a minimum that it should prove"


# ------------------------------------------------------------------------------------------- one after the other


@dataclass(frozen=True)
class Single:
    """One problem as a user writes it, and how to score what comes back.

    Attributes:
        given: What ``solve`` is given.
        score: The energy of an answer, as it is written, in whole numbers.
        lowest: The minimum among the states that keep all constraints; None if there is none.
        kept: Whether an answer keeps all constraints.
    """

    given: Any
    score: Callable[[Any], int]
    lowest: int | None
    kept: Callable[[Any], bool] = lambda _: True


def matrix_of_integers(random: np.random.Generator) -> Single:
    n = int(random.integers(1, 9))
    most = 2 ** int(random.choice([1, 8, 40, 55]))
    matrix = random.integers(-most, most, (n, n), endpoint=True)
    exact = [[int(q) for q in row] for row in matrix]

    def score(x: Any) -> int:
        return sum(exact[i][j] for i in range(n) for j in range(n) if x[i] and x[j])

    return Single(matrix, score, min(map(score, states(n))))


def labels(random: np.random.Generator) -> Single:
    names = ["a", ("b", 1), 7, "δ", "long name"][: int(random.integers(1, 6))]
    pairs = {(i, j): int(random.integers(-9, 10)) for i in names for j in names if random.random() < 0.7}
    pairs |= {(i, i): int(random.integers(-9, 10)) for i in names}

    def score(x: Any) -> int:
        return sum(q for (i, j), q in pairs.items() if x[i] and x[j])

    every = (dict(zip(names, row, strict=True)) for row in states(len(names)))
    return Single(pairs, score, min(map(score, every)))


def spins(random: np.random.Generator) -> Single:
    n = int(random.integers(1, 9))
    h = {i: int(random.integers(-9, 10)) for i in range(n)}
    pairs = {(i, j): int(random.integers(-9, 10)) for i in range(n) for j in range(i) if random.random() < 0.6}

    def score(s: Any) -> int:
        return int(sum(h[i] * s[i] for i in h) + sum(q * s[i] * s[j] for (i, j), q in pairs.items()))

    every = (dict(enumerate(row)) for row in 2 * states(n) - 1)
    return Single((h, pairs), score, min(map(score, every)))


def cut(random: np.random.Generator) -> Single:
    graph = networkx.gnp_random_graph(int(random.integers(2, 10)), 0.6, seed=int(random.integers(2**31)))
    for _, _, facts in graph.edges(data=True):
        facts["weight"] = int(random.integers(-5, 6))

    def score(side: Any) -> int:
        return -sum(facts["weight"] for i, j, facts in graph.edges(data=True) if side[i] != side[j])

    every = (dict(zip(graph, row, strict=True)) for row in states(len(graph)))
    return Single(graph, score, min(map(score, every)))


def max_sat(random: np.random.Generator) -> Single:
    """Soft clauses of up to four literals, some of them hard."""
    n = int(random.integers(1, 8))
    count = int(random.integers(1, 4 * n + 1))
    clauses = [
        [int(v) * int(random.choice([-1, 1])) for v in random.integers(1, n + 1, random.integers(1, 5))]
        for _ in range(count)
    ]
    weights, hard = [int(w) for w in random.integers(0, 20, count)], random.random(count) < 0.2
    soft = [k for k in range(count) if not hard[k]]
    problem = WeightedMaxSat.from_clauses(n, [clauses[k] for k in soft], [weights[k] for k in soft])

    def true(literals: list[int], x: Any) -> bool:
        return any(bool(x[abs(literal) - 1]) == (literal > 0) for literal in literals)

    def score(x: Any) -> int:
        return sum(weights[k] for k in soft if not true(clauses[k], x))

    def kept(x: Any) -> bool:
        return all(true(clauses[k], x) for k in range(count) if hard[k])

    feasible = [score(x) for x in states(n) if kept(x)]
    rows = [clause(clauses[k]) for k in range(count) if hard[k]]
    given = Constrained.of(problem, rows) if rows else problem
    return Single(given, score, min(feasible) if feasible else None, kept)


def constrained(random: np.random.Generator) -> Single:
    """A matrix with linear constraints, from below, from above and from both sides."""
    n = int(random.integers(2, 8))
    matrix = random.integers(-9, 10, (n, n))
    rows = []
    for _ in range(random.integers(1, 4)):
        chosen = random.choice(n, int(random.integers(1, n + 1)), replace=False)
        numbers = {int(v): int(random.integers(-3, 4)) for v in chosen}
        lower = int(random.integers(-3, 4))
        ends = [(lower, None), (None, lower), (lower, lower), (lower, lower + int(random.integers(0, 3)))]
        rows.append(Linear(numbers, *ends[int(random.integers(4))]))

    def score(x: Any) -> int:
        return int(sum(int(matrix[i, j]) for i in range(n) for j in range(n) if x[i] and x[j]))

    def kept(x: Any) -> bool:
        sums = [sum(a * int(x[v]) for v, a in row.coefficients.items()) for row in rows]
        return all(
            (row.lower is None or row.lower <= total) and (row.upper is None or total <= row.upper)
            for row, total in zip(rows, sums, strict=True)
        )

    feasible = [score(x) for x in states(n) if kept(x)]
    given = Constrained.of(Qubo.from_matrix(matrix.astype(np.float64)), rows)
    return Single(given, score, min(feasible) if feasible else None, kept)


def check_single(single: Single, name: str, solver: QuboSolver, seed: int) -> Iterator[str]:
    found = solve(single.given, solver=solver, seed=seed, n_solutions=3)
    for state in found.solutions:
        exact = single.score(state.values)
        if state.energy != exact:
            yield f"{name}: energy {state.energy!r} reported of {state.values}, {exact} in integers"
    if found.best_energy != found.solutions[0].energy:
        yield f"{name}: the best energy {found.best_energy!r} is not that of the first solution"
    kept = single.kept(found.best)
    if single.lowest is None:
        if kept or found.status not in (Status.INFEASIBLE, Status.NOT_FEASIBLE):
            yield f"{name}: status {found.status.name}, although no state keeps all constraints"
        return
    if found.status is Status.INFEASIBLE:
        yield f"{name}: called infeasible, although {single.lowest} is reached"
    if not kept:
        if found.status is not Status.NOT_FEASIBLE:
            yield f"{name}: a broken constraint, and status {found.status.name}"
        return
    if found.best_energy < single.lowest:
        yield f"{name}: {found.best_energy!r} is below the minimum {single.lowest}"
    if found.status is Status.OPTIMAL and found.best_energy != single.lowest:
        yield f"{name}: {found.best_energy!r} is called proven, {single.lowest} is the minimum"
    if found.lower_bound > single.lowest:
        yield f"{name}: the lower bound {found.lower_bound!r} is above the minimum {single.lowest}"


# ------------------------------------------------------------------------------------------------- the campaign

BATCHES = {"dense": dense, "two layers": two_layers}
SINGLES = {
    "matrix of integers": matrix_of_integers,
    "pairs with labels": labels,
    "spins": spins,
    "cut of a graph": cut,
    "MAX-SAT, some clauses hard": max_sat,
    "linear constraints": constrained,
}
KINDS = [*(f"{name}, {dtype}" for name in BATCHES for dtype in ("float32", "float64")), *SINGLES]


def attempt(case: str) -> ledger.Outcome:
    """A hundred problems of one kind through every solver."""
    kind = case.rpartition("/")[0]
    seed = zlib.crc32(case.encode())
    findings: list[str] = []
    if kind in SINGLES:
        for at in range(AT_ONCE):
            random = np.random.default_rng([seed, at])
            single = SINGLES[kind](random)
            for name, solver in SOLVERS_HERE.items():
                findings += _guarded(check_single, single, name, solver, seed, f"problem {at}")
    else:
        name_of_batch, dtype = kind.split(", ")
        batch = BATCHES[name_of_batch](np.random.default_rng(seed), np.dtype(dtype).type)
        for name, solver in SOLVERS_HERE.items():
            findings += _guarded(check_batch, batch, name, solver, seed, "")
    return ledger.Outcome(kind=kind, tried=AT_ONCE, findings=findings)


def _guarded(check: Any, problem: Any, name: str, solver: Any, seed: int, where: str) -> list[str]:
    """What a check finds; a refusal of a problem that the solver is not for is none, any other error is one."""
    try:
        return [f"{where} {found}".strip() for found in check(problem, name, solver, seed)]
    except SettingError as error:
        return [] if name in PROVING else [f"{where} {name}: refused: {error}".strip()]
    except Exception as error:
        return [f"{where} {name}: {type(error).__name__}: {error}".strip()]


SOLVERS_HERE = solvers()


def cases(count: int) -> list[str]:
    """As many cases as make so many problems; nine of ten are of the kinds that are solved a hundred at once."""
    batches, singles = KINDS[: -len(SINGLES)], KINDS[-len(SINGLES) :]
    found = []
    for number in range(count // AT_ONCE):
        kinds = singles if number % 10 == 9 else batches
        found.append(f"{kinds[(number // 10 if number % 10 == 9 else number) % len(kinds)]}/{number:05d}")
    return found


def main() -> int:
    arguments = ledger.parser(__doc__, count=100_000, what="problems").parse_args()
    return ledger.run(arguments.out, cases(arguments.count), attempt, workers=arguments.workers)


if __name__ == "__main__":
    sys.exit(main())
