"""Problems with constraints: hard clauses, exactly k of some variables, sums of whole numbers with bounds."""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.arrays import Array, alike, cast, to_numpy
from memcomp_lightning.errors import require
from memcomp_lightning.problems.maxsat import Clauses, WeightedMaxSat, as_qubo
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.problems.rows import Integers, Rows, plus_rows

# ------------------------------------------------------------------------------------------------- one constraint


class Linear(NamedTuple):
    """``lower <= sum of coefficient x <= upper``, in whole numbers, over variables counted from 0.

    Attributes:
        coefficients: Of each variable.
        lower: Smallest allowed sum; None is any.
        upper: Largest allowed sum; None is any.
    """

    coefficients: Mapping[int, int]
    lower: int | None = None
    upper: int | None = None


def exactly(k: int, variables: Iterable[int]) -> Linear:
    """Exactly k of these variables are 1; variables count from 0.

    >>> exactly(1, [0, 2])
    Linear(coefficients={0: 1, 2: 1}, lower=1, upper=1)
    """
    return Linear(dict.fromkeys(variables, 1), k, k)


def clause(literals: Iterable[int]) -> Linear:
    """At least one literal holds, written as in DIMACS: 3 is variable number 3 (the first is 1), -3 its negation.

    >>> clause([1, -3])
    Linear(coefficients={0: 1, 2: -1}, lower=0, upper=None)
    """
    chosen = set(literals)
    require(0 not in chosen, "literal", 0, "an integer other than 0, as variables count from 1 in a clause")
    coefficients: dict[int, int] = {}
    for literal in chosen:
        coefficients[abs(literal) - 1] = coefficients.get(abs(literal) - 1, 0) + (1 if literal > 0 else -1)
    return Linear(coefficients, 1 - sum(literal < 0 for literal in chosen))


# -------------------------------------------------------------------------------------------------------- many


@dataclass(frozen=True, slots=True, eq=False)
class Constraints:
    """Rows ``lower <= a . x <= upper`` of whole numbers, one after another.

    A row that bounds its sum from above alone is kept with its signs changed, a common factor of the coefficients
    is left out, and bounds that no state passes are the smallest and the largest sum. Where no sum lies within the
    bounds, they are one above the largest.

    Attributes:
        begins: Where the variables of each row begin, ``(n_rows + 1,)`` int64.
        variables: ``(n_entries,)`` int64, those of a row differ and rise.
        coefficients: ``(n_entries,)`` int64, none is 0.
        lower: ``(n_rows,)`` int64.
        upper: ``(n_rows,)`` int64.
    """

    begins: Integers
    variables: Integers
    coefficients: Integers
    lower: Integers
    upper: Integers

    @staticmethod
    def of(n: int, rows: Iterable[Linear]) -> "Constraints":
        """Rows over n variables.

        Raises:
            SettingError: A variable is outside 0 to n - 1, or a number is not whole or beyond 2^31.
        """
        lengths, entries, bounds = [0], list[tuple[int, int]](), list[tuple[int, int]]()
        for number, (coefficients, lower, upper) in enumerate(rows, start=1):
            outside = [variable for variable in coefficients if not 0 <= variable < n]
            require(
                not outside, f"variables of constraint {number}", outside, f"integers from 0 to n - 1 = {n - 1}"
            )
            size = sum(map(abs, coefficients.values()))
            whole = all(math.isfinite(a) and int(a) == a for a in (*coefficients.values(), lower or 0, upper or 0))
            require(
                whole and size < 2**31,
                f"coefficients and bounds of constraint {number}",
                (dict(coefficients), lower, upper),
                "whole numbers, and coefficients whose sizes add up to less than 2^31",
            )
            unit = math.gcd(*map(int, coefficients.values())) or 1
            row = sorted((variable, int(a) // unit) for variable, a in coefficients.items() if a)
            least, most = sum(min(a, 0) for _, a in row), sum(max(a, 0) for _, a in row)
            low = least if lower is None else max(-(-int(lower) // unit), least)
            high = most if upper is None else min(int(upper) // unit, most)
            if low > high:
                low = high = most + 1
            elif low == least and high < most:
                row, low, high = [(variable, -a) for variable, a in row], -high, -low
            lengths.append(len(row))
            entries += row
            bounds.append((low, high))
        variables, coefficients_ = np.array(entries, np.int64).reshape(-1, 2).T
        low_and_high = np.array(bounds, np.int64).reshape(-1, 2).T
        return Constraints(np.cumsum(lengths), variables, coefficients_, *low_and_high)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.lower)

    @property
    def lengths(self) -> Integers:
        """Number of variables of each row, ``(n_rows,)``."""
        return np.diff(self.begins)

    @property
    def row(self) -> Integers:
        """The row of each entry, ``(n_entries,)``."""
        return np.repeat(np.arange(len(self)), self.lengths)

    @property
    def are_clauses(self) -> bool:
        """Whether every row asks for at least one true literal."""
        n_negated, n_positive = (
            np.bincount(self.row, self.coefficients == a, minlength=len(self)) for a in (-1, 1)
        )
        return bool(((self.lower == 1 - n_negated) & (self.upper == n_positive)).all()) and bool(
            (np.abs(self.coefficients) == 1).all()
        )

    @property
    def _may_break(self) -> NDArray[np.bool_]:
        """Which rows some state breaks, ``(n_rows,)``."""
        least, most = (sums_of(part(self.coefficients, 0), self.begins) for part in (np.minimum, np.maximum))
        return (self.lower > least) | (self.upper < most)

    def sums(self, x: NDArray[np.bool_]) -> Integers:
        """``a . x`` of each row, ``(*leading, n_rows)``, of states ``(*leading, n)``."""
        return sums_of(np.where(x[..., self.variables], self.coefficients, 0), self.begins)

    def excess(self, sums: Integers, rows: Integers | slice = slice(None)) -> Integers:
        """How far sums lie outside the bounds of their rows, >= 0."""
        return np.maximum(self.lower[rows] - sums, 0) + np.maximum(sums - self.upper[rows], 0)

    def blocks(self) -> Iterator[tuple[Integers, Integers, Integers, Integers, int]]:
        """Rows of one length and width: their numbers, variables, coefficients, smallest sums, and the width."""
        width = self.upper - self.lower
        kinds, kind_of = np.unique(np.stack((self.lengths, width)), axis=1, return_inverse=True)
        for kind, (length, width_) in enumerate(kinds.T.tolist()):
            rows = np.flatnonzero((kind_of == kind) & self._may_break)
            if not rows.size:
                continue
            at = self.begins[rows, None] + np.arange(length)
            yield rows, self.variables[at], self.coefficients[at], self.lower[rows], width_


def sums_of(entries: Integers, begins: Integers) -> Integers:
    """Sums of the entries of each group, ``(*leading, n_groups)``, exact in integers."""
    total = np.zeros((*entries.shape[:-1], entries.shape[-1] + 1), entries.dtype)
    np.cumsum(entries, axis=-1, out=total[..., 1:])
    return np.diff(total[..., begins], axis=-1)


# ------------------------------------------------------------------------------------------------- the problem


@dataclass(frozen=True, slots=True, eq=False)
class Constrained:
    """Minimise an objective over the states that keep all constraints.

    Attributes:
        objective: What to minimise: one problem, or several that share the constraints.
        constraints: What has to hold.

    >>> three = Constrained.of(Qubo.from_matrix(np.diag([3.0, -1.0, 2.0])), [exactly(2, [0, 1, 2])])
    >>> x = np.array([[0, 1, 1], [0, 1, 0]])
    >>> three.energy(x).tolist(), three.n_broken(x).tolist()
    ([1.0, -1.0], [0, 1])
    """

    objective: Qubo | WeightedMaxSat
    constraints: Constraints

    @staticmethod
    def of(objective: Qubo | WeightedMaxSat, constraints: Collection[Linear]) -> "Constrained":
        """The problem of these constraints.

        Raises:
            SettingError: A constraint names a variable that there is not, or a number that is not whole.
        """
        allowed = "a Qubo or WeightedMaxSat", "Linear(...), exactly(...) or clause(...)"
        require(isinstance(objective, Qubo | WeightedMaxSat), "objective", type(objective).__name__, allowed[0])
        for constraint in constraints:
            require(isinstance(constraint, Linear), "constraint", constraint, allowed[1])
            whole = all(isinstance(variable, Integral) for variable in constraint.coefficients)
            require(whole, "variables of a constraint", list(constraint.coefficients), "integers from 0 to n - 1")
        return Constrained(objective, Constraints.of(objective.n, constraints))

    @property
    def n(self) -> int:
        """Number of variables."""
        return self.objective.n

    def energy(self, x: Array) -> Array:
        """The objective, whatever the constraints say, ``(*problems, n_states)``."""
        return self.objective.energy(x)

    def n_broken(self, x: Array) -> Array:
        """Number of constraints that each state breaks, ``(*leading, n_states)`` int64, counted in integers."""
        rows = self.constraints
        return alike((rows.excess(rows.sums(to_numpy(x) > 0.5)) > 0).sum(-1), x)

    def penalised(self, penalties: Array) -> Qubo | WeightedMaxSat:
        """The objective plus what broken constraints cost; auxiliary variables of a QUBO come after the n.

        Where all constraints are clauses and the objective is MAX-SAT, so is this problem.

        Args:
            penalties: What each constraint costs that is broken by one, ``(*problems, n_constraints)``.
        """
        objective, rows = self.objective, self.constraints
        if isinstance(objective, Qubo):
            objective = objective.floating()
        like = objective.linear if isinstance(objective, Qubo) else objective.unit
        weights = cast(alike(penalties, like), like.dtype)
        if isinstance(objective, WeightedMaxSat) and rows.are_clauses:
            return objective.plus_clauses(
                Clauses(alike(x, like), cast(alike(a, like), like.dtype), weights[..., alike(of_rows, like)])
                for of_rows, x, a, _, _ in rows.blocks()
            )
        blocks = (Rows(x, a, low, width, weights[..., of_rows]) for of_rows, x, a, low, width in rows.blocks())
        return plus_rows(as_qubo(objective), blocks)
