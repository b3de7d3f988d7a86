"""Turn a file's entries into a problem to minimise, and count an answer exactly as the file's authors do."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress, pairwise
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.arrays import double
from memcomp_lightning.problems.constrained import Constrained, clause
from memcomp_lightning.problems.files.numbers import LARGEST_INT64, Exact, Numbers, in_full
from memcomp_lightning.problems.files.source import Source
from memcomp_lightning.problems.maxsat import WeightedMaxSat, to_qubo
from memcomp_lightning.problems.qubo import Qubo

Bits = NDArray[np.bool_]


class Score(NamedTuple):
    """An assignment in the terms of the problem's file.

    Attributes:
        value: The objective, such as the cut weight; of MAX-SAT what the unsatisfied soft clauses weigh. Exact: an
            integer where it is whole, else a fraction; of an RBM a float.
        hard_unsatisfied: Number of unsatisfied hard clauses; the value counts for nothing unless it is 0.
    """

    value: Exact | float
    hard_unsatisfied: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """What the authors of a file count, and which way.

    Attributes:
        name: Such as "cut weight".
        counting: How it is counted, over the problem's variables.
        maximised: Whether more is better; the energy to minimise is then minus the value.
        penalty: What an unsatisfied hard clause adds to the energy, more than all soft ones together.
    """

    name: str
    counting: "Terms | ClauseList | RbmEnergy"
    maximised: bool = False
    penalty: Exact = 0

    @property
    def direction(self) -> str:
        """``"maximise"`` or ``"minimise"``."""
        return "maximise" if self.maximised else "minimise"

    def energy(self, score: Score) -> Exact | float:
        """What the solvers minimise, of a state with this score: feasibility ranks before cost."""
        value = -score.value if self.maximised else score.value
        return value + self.penalty * score.hard_unsatisfied if score.hard_unsatisfied else value


@dataclass(frozen=True, slots=True, eq=False)
class Parsed:
    """What stands in a file.

    Attributes:
        problem: What to minimise, in float64, over those variables that the file uses.
        objective: What the file's authors count.
        n: Number of variables of the file.
        variables: ``(n_used,)`` int64, the variables of ``problem`` among those of the file, counted from 0.
        remarks: What a person should know of how the file was read, a sentence each.
        integers: ``problem`` as integers, in units of its numbers' last digit, for solvers that prove; None where
            int64 does not hold its sums, or for clauses of three literals and more.
        resolved: Whether float64 tells apart all energies that differ.
        constrained: ``problem`` with its hard clauses apart, for solvers that prove nothing; None without any.
    """

    problem: Qubo | WeightedMaxSat
    objective: Objective
    n: int
    variables: NDArray[np.int64]
    remarks: tuple[str, ...] = ()
    integers: Qubo | None = None
    resolved: bool = True
    constrained: Constrained | None = None


# ------------------------------------------------------------------------------------------ terms of two variables


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """A sum over listed pairs.

    Attributes:
        kind: What a number is multiplied with: x_i x_j, whether x_i and x_j differ, or s_i s_j with s = 2 x - 1;
            where i = j this is x_i, 0 and s_i.
        i: First variable of each pair, ``(n_terms,)`` int64.
        j: Second variable, likewise.
        numbers: The numbers; the last one, which has no pair, is added always.
    """

    kind: Literal["product", "cut", "spin"]
    i: NDArray[np.int64]
    j: NDArray[np.int64]
    numbers: Numbers

    @property
    def unit(self) -> float:
        """Sums are multiples of it."""
        return float(10.0**-self.numbers.decimals)

    def count(self, x: Bits) -> Score:
        """The sum, without rounding."""
        values, constant = self.numbers.integers[:-1], int(self.numbers.integers[-1])
        a, b = x[self.i], x[self.j]
        if self.kind == "product":
            total = int(values[a & b].sum())
        elif self.kind == "cut":
            total = int(values[a != b].sum())
        else:
            plus = np.where(self.i == self.j, a, a == b)
            total = int(values[plus].sum()) - int(values[~plus].sum())
        return Score(self.numbers.exact(total + constant))


def from_terms(
    source: Source, name: str, n: int, terms: Terms, *, maximised: bool = False, remarks: Sequence[str] = ()
) -> Parsed:
    """The problem whose energy is the sum, or minus the sum if it is maximised, over the variables used."""
    used, position = np.unique(np.concatenate((terms.i, terms.j)), return_inverse=True)
    i, j = position[: len(terms.i)], position[len(terms.i) :]
    numbers, sign = terms.numbers, -1 if maximised else 1
    terms = Terms(terms.kind, i, j, numbers)
    size = 9 * numbers.total  # a pair of spins: 4 x_i x_j - 2 x_i - 2 x_j + 1
    integers = None
    if numbers.integers.dtype != object:  # energies fit: sums on the way that overflow wrap round, and back again
        integers = sum_as_qubo(terms.kind, len(used), i, j, sign * numbers.integers)
    _check_size(source, numbers.exact(size))
    if integers is None or size > LARGEST_INT64 or numbers.decimals > 22:  # 10^22 is the last that float64 holds
        problem = sum_as_qubo(terms.kind, len(used), i, j, sign * numbers.double())
    else:
        parts = (integers.coupling, integers.linear, integers.offset)
        size = sum(int(abs(part).sum()) for part in parts)
        problem = Qubo(integers.graph, *(double(part) / 10**numbers.decimals for part in parts))
    said = [*remarks, *_repeated(i, j, problem), *_rounding(numbers.exact(size), size)]
    objective = Objective(name, terms, maximised)
    resolved = _resolved(size, numbers.decimals, len(i))
    return Parsed(problem, objective, n, used.astype(np.int64), tuple(said), integers, resolved)


def sum_as_qubo(
    kind: Literal["product", "cut", "spin"],
    n: int,
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    values: NDArray[Any],
) -> Qubo:
    """Such a sum as :class:`Terms` is, as a QUBO of the same dtype as the values; the last of these is added."""
    v, constant = values[:-1], values[-1]
    if kind == "product":
        return Qubo.from_coo(n, i, j, v, constant)
    own = i == j
    (a, b, w), (k, h) = (t[~own] for t in (i, j, v)), (t[own] for t in (i, v))
    if kind == "cut":
        return Qubo.from_coo(
            n, np.concatenate((a, a, b)), np.concatenate((b, a, b)), np.concatenate((-2 * w, w, w)), constant
        )
    return Qubo.from_coo(
        n,
        np.concatenate((a, a, b, k)),
        np.concatenate((b, a, b, k)),
        np.concatenate((4 * w, -2 * w, -2 * w, 2 * h)),
        constant + w.sum() - h.sum(),
    )


def _repeated(i: NDArray[np.int64], j: NDArray[np.int64], problem: Qubo) -> list[str]:
    """A remark on pairs that are listed more than once."""
    n, n_pairs = problem.n, problem.graph.edges().shape[0] + len(np.unique(i[i == j]))
    if n_pairs == len(i):
        return []
    n_ordered = len(np.unique(i * n + j))
    ways = [way for way, is_met in (("again", n_ordered < len(i)), (_REVERSED, n_pairs < n_ordered)) if is_met]
    return [f"{len(i) - n_pairs} of the {len(i)} entries list a pair {' or '.join(ways)}: the numbers add up."]


_REVERSED = "in the other direction"


# ------------------------------------------------------------------------------------------ what float64 can hold


def _check_size(source: Source, size: Exact) -> None:
    """Refuse numbers whose sums are infinite in float64."""
    if size > _LARGEST_SUM:
        raise source.fault(f"numbers whose sums reach {_short(size)}", "sums that float64 holds, below 1e307")


_LARGEST_SUM = 10**307


def _resolved(size: int, decimals: int, n_terms: int) -> bool:
    """Whether sums in float64 tell apart what differs by one unit; ``size`` bounds the sums, in units."""
    return size <= 2**53 if decimals == 0 else size * (n_terms + 2) <= 2**51


def _rounding(size: Exact, units: int) -> list[str]:
    """A remark on numbers whose sums float64 rounds."""
    if units <= 2**53:
        return []
    return [
        f"Sums reach {_short(size)}; float64 holds 2^53 = 9007199254740992 steps of the last digit. "
        "Solvers but brute_force rank by rounded sums; what is reported is counted exactly."
    ]


def _short(value: Exact) -> str:
    """A total, whole or as a power of ten."""
    text = in_full(value)
    return text if len(text) <= 40 else f"about 1e{len(str(math.floor(value))) - 1}"


# -------------------------------------------------------------------------------------------------------- clauses


@dataclass(frozen=True, slots=True, eq=False)
class ClauseList:
    """Clauses as the file lists them.

    Attributes:
        literals: ``(n_literals,)`` int64 as in DIMACS, all clauses after one another.
        clause: ``(n_literals,)`` int64, the clause that a literal belongs to.
        weight: Of each clause, ``(n_clauses,)``; of hard clauses 0.
        hard: ``(n_clauses,)`` bool.
    """

    literals: NDArray[np.int64]
    clause: NDArray[np.int64]
    weight: Numbers
    hard: Bits

    @property
    def unit(self) -> float:
        """Sums are multiples of it."""
        return float(10.0**-self.weight.decimals)

    def count(self, x: Bits) -> Score:
        """Weight of the unsatisfied soft clauses, number of the unsatisfied hard ones."""
        true = x[np.abs(self.literals) - 1] == (self.literals > 0)
        unsatisfied = np.ones(len(self.hard), np.bool_)
        unsatisfied[self.clause[true]] = False
        weight = self.weight.exact(int(self.weight.integers[unsatisfied].sum()))
        return Score(weight, int((unsatisfied & self.hard).sum()))


def from_clauses(
    source: Source,
    name: str,
    n: int,
    clauses: list[list[int]],
    weights: list[Exact],
    hard: list[bool],
    remarks: Sequence[str] = (),
) -> Parsed:
    """The MAX-SAT problem of a file's clauses; a hard one weighs more than all soft ones together."""
    lengths = [len(clause) for clause in clauses]
    flat = np.array([literal for clause in clauses for literal in clause], np.int64)
    used, position = np.unique(np.abs(flat), return_inverse=True)
    flat = np.sign(flat) * (position + 1)
    literals, ends = flat.tolist(), np.cumsum([0, *lengths]).tolist()
    renamed = [literals[begin:end] for begin, end in pairwise(ends)]
    soft, is_hard = Numbers.of(weights), np.array(hard, np.bool_)
    penalty = _penalty(soft.total, 10**soft.decimals) if any(hard) else 0
    units = [penalty if h else weight for weight, h in zip(soft.integers.tolist(), hard, strict=True)]
    size = 4 * sum(units)  # a clause of two literals: 1 - x_i - x_j + x_i x_j
    _check_size(source, soft.exact(size))
    problem = WeightedMaxSat.from_clauses(len(used), renamed, [soft.exact(unit) for unit in units])
    integers = None
    if sum(units) <= LARGEST_INT64 and all(len(set(clause)) <= 2 for clause in renamed):
        integers = to_qubo(WeightedMaxSat.from_clauses(len(used), renamed, units, dtype=np.int64))
    n_empty = int((is_hard & (np.array(lengths, np.int64) == 0)).sum())
    empty = [f"{n_empty} hard clause{'s are' if n_empty > 1 else ' is'} empty: no assignment satisfies all."]
    said = [*remarks, *(empty if n_empty else ()), *_rounding(soft.exact(size), size)]
    listed = ClauseList(flat, np.repeat(np.arange(len(clauses)), lengths), soft, is_hard)
    objective = Objective(name, listed, penalty=soft.exact(penalty))
    resolved = _resolved(size, soft.decimals, len(clauses))
    constrained = None
    if any(hard):
        clauses_, weights_ = list(compress(renamed, ~is_hard)), list(compress(weights, ~is_hard))
        soft_alone = WeightedMaxSat.from_clauses(len(used), clauses_, weights_)
        constrained = Constrained.of(soft_alone, [clause(found) for found in compress(renamed, is_hard)])
    return Parsed(problem, objective, n, used - 1, tuple(said), integers, resolved, constrained)


def _penalty(total: int, one: int) -> int:
    """Weight of a hard clause: that of all soft ones together, plus 1 or a 1024th of it if that is more.

    The compiled kernels rank states in float32, where a smaller margin would be rounded off. Soft clauses of less
    than 1 together are outweighed by twice their weight: next to a margin of 1 they could be rounded off.
    """
    margin = min(one, total) or one
    return total + max(margin, -(-total // 1024))


# ------------------------------------------------------------------------------------------------------------ RBMs


@dataclass(frozen=True, slots=True, eq=False)
class RbmEnergy:
    """``E(v, h)`` of float64 arrays, rounded once.

    Attributes:
        weight: ``(n_hidden, n_visible)``.
        b: ``(n_visible,)``.
        c: ``(n_hidden,)``.
    """

    unit: ClassVar[None] = None
    weight: NDArray[np.float64]
    b: NDArray[np.float64]
    c: NDArray[np.float64]

    def count(self, x: Bits) -> Score:
        """The energy: the sum of what is on, whatever its order."""
        v, h = x[: len(self.b)], x[len(self.b) :]
        on = np.concatenate((self.weight[h][:, v].ravel(), self.b[v], self.c[h]))
        return Score(0.0 - math.fsum(on.tolist()))
