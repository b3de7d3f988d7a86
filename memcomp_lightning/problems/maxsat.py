"""Weighted MAX-SAT: clauses of any length, and its exact equivalence with QUBO."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from memcomp_lightning.arrays import (
    AnyArray,
    Array,
    add_up,
    alike,
    as_array,
    cast,
    double,
    namespace,
    to_numpy,
)
from memcomp_lightning.errors import require
from memcomp_lightning.problems.graph import EdgeList, Graph
from memcomp_lightning.problems.qubo import Qubo, wide
from memcomp_lightning.problems.rows import Rows, plus_rows


@dataclass(frozen=True, slots=True, eq=False)
class Clauses:
    """Clauses of one length, three literals or more.

    Attributes:
        variables: ``(n_clauses, length)`` int64, the variables of a clause differ.
        polarity: ``(n_clauses, length)``, +1 for a variable, -1 for its negation.
        weight: Clause weights >= 0, ``(*problems, n_clauses)``.
    """

    variables: Array
    polarity: Array
    weight: Array

    def unsatisfied_weight(self, x: Array) -> Array:
        """Total weight of unsatisfied clauses in float64, ``(*problems, n_states)``, of states in {0, 1}."""
        false = (x[..., self.variables] > 0.5) != (self.polarity > 0)
        return (double(false.all(-1)) @ double(self.weight)[..., None])[..., 0]

    def rows(self) -> Rows:
        """At least one literal is true: a row for each clause."""
        polarity = to_numpy(self.polarity).astype(np.int64)
        n_negated = (polarity < 0).sum(1)
        return Rows(to_numpy(self.variables), polarity, 1 - n_negated, polarity.shape[1] - 1, self.weight)

    def field(self, x: Array) -> Array:
        """Unsatisfied weight of x_i = 1 less that of x_i = 0, ``(*problems, n_states, n)``."""
        false = (x[..., self.variables] > 0.5) != (self.polarity > 0)
        # A literal decides its clause where all others are false.
        decides = (~false).sum(-1)[..., None] == ~false
        push = -double(self.polarity) * double(self.weight)[..., None, :, None] * decides
        return add_up(push.reshape(*push.shape[:-2], -1), self.variables.reshape(-1), x.shape[-1])


@dataclass(frozen=True, slots=True, eq=False)
class WeightedMaxSat:
    r"""Minimise the total weight of unsatisfied clauses.

    One clause a pair of the graph, ``(first literal or second literal)``, one unit clause a variable, and
    longer clauses. A literal is the variable (polarity +1) or its negation (polarity -1).

    Attributes:
        graph: The pairs of variables that share a clause.
        weight: Clause weights >= 0, ``(*problems, *graph.edge_shape)``.
        first: Polarity of the first literal, +1 or -1, broadcastable to ``weight``.
        second: Polarity of the second literal, likewise.
        unit: Signed weights of the unit clauses, ``(*problems, n)``: > 0 asks for x = 1, < 0 for x = 0.
        offset: ``(*problems,)`` float64; unsatisfied weight + offset is the energy.
        longer: Clauses of three literals and more, one entry a length.
    """

    graph: Graph
    weight: Array
    first: Array
    second: Array
    unit: Array
    offset: Array
    longer: tuple[Clauses, ...] = ()

    @property
    def n(self) -> int:
        """Number of variables."""
        return self.graph.n

    @property
    def problems(self) -> tuple[int, ...]:
        """Leading axes of independent problems."""
        return tuple(self.offset.shape)

    def without_longer(self) -> "WeightedMaxSat":
        """The same problem without its clauses of three literals and more."""
        return replace(self, longer=())

    def plus_clauses(self, blocks: Iterable[Clauses]) -> "WeightedMaxSat":
        """Add clauses, of one length a block; their variables are sorted."""
        xp, flat = namespace(self.unit), (*self.problems, -1)
        pairs, unit, offset = [alike(self.graph.edges(), self.unit)], self.unit, double(self.offset)
        weight = [self.weight.reshape(flat)]
        ends = [[xp.broadcast_to(part, self.weight.shape).reshape(flat)] for part in (self.first, self.second)]
        longer = {block.variables.shape[1]: block for block in self.longer}
        for block in blocks:
            length = block.variables.shape[1]
            if length == 0:
                offset = offset + double(block.weight).sum(-1)
            elif length == 1:
                pull = block.weight * block.polarity[:, 0]
                before, unit = unit, unit + add_up(pull, block.variables[:, 0], self.n)
                # A unit u costs max(u, 0) - u x.
                offset = offset + double(pull.clip(min=0)).sum(-1)
                offset = offset + (double(before).clip(min=0) - double(unit).clip(min=0)).sum(-1)
            elif length == 2:
                pairs.append(block.variables)
                weight.append(block.weight)
                for k, end in enumerate(ends):
                    end.append(xp.broadcast_to(block.polarity[:, k], block.weight.shape))
            elif length in longer:
                both = longer[length], block
                longer[length] = Clauses(
                    variables=xp.concat([part.variables for part in both]),
                    polarity=xp.concat([part.polarity for part in both]),
                    weight=xp.concat([part.weight for part in both], axis=-1),
                )
            else:
                longer[length] = block
        first, second = (xp.concat(end, axis=-1) for end in ends)
        return WeightedMaxSat(
            graph=EdgeList(n=self.n, pairs=xp.concat(pairs)),
            weight=xp.concat(weight, axis=-1),
            first=first,
            second=second,
            unit=unit,
            offset=offset,
            longer=tuple(longer[length] for length in sorted(longer)),
        )

    def alike(self, like: AnyArray) -> "WeightedMaxSat":
        """The same problem in the library and on the device of ``like``: a tensor, as to solve it on a GPU."""
        names = ("weight", "first", "second", "unit", "offset")
        parts = {name: alike(getattr(self, name), like) for name in names}
        longer = (
            Clauses(*(alike(part, like) for part in (block.variables, block.polarity, block.weight)))
            for block in self.longer
        )
        return WeightedMaxSat(graph=self.graph.alike(like), **parts, longer=tuple(longer))

    def energy(self, x: Array) -> Array:
        """Unsatisfied weight + offset in float64, ``(*problems, n_states)``, of ``x (*problems, n_states, n)``."""
        return self.unsatisfied_weight(x) + double(self.offset)[..., None]

    def unsatisfied_weight(self, x: Array) -> Array:
        """Total weight of unsatisfied clauses in float64, ``(*problems, n_states)``, of states in {0, 1}."""
        x, n_axes = alike(x, self.unit), len(self.graph.edge_shape)
        false = [
            (1 - (2 * value - 1) * over_states(polarity, n_axes)) / 2
            for value, polarity in zip(self.graph.gather(double(x)), (self.first, self.second), strict=True)
        ]
        clauses = (over_states(double(self.weight), n_axes) * false[0] * false[1]).sum(edge_axes(self.graph))
        unit = double(self.unit)[..., None, :]
        units = (abs(unit) * ((x > 0.5) != (unit > 0))).sum(-1)
        return clauses + units + sum(block.unsatisfied_weight(x) for block in self.longer)

    def field(self, x: Array) -> Array:
        """Energy of x_i = 1 less energy of x_i = 0 in float64, ``(*problems, n_states, n)``, of binary states."""
        n_axes, spins = len(self.graph.edge_shape), self.graph.gather(2 * double(x) - 1)
        polarity = [over_states(double(q), n_axes) for q in (self.first, self.second)]
        false = [(1 - q * spin) / 2 for q, spin in zip(polarity, spins, strict=True)]
        weight = over_states(double(self.weight), n_axes)
        total = self.graph.scatter(-weight * polarity[0] * false[1], -weight * polarity[1] * false[0])
        total = total - double(self.unit)[..., None, :]
        for block in self.longer:
            total = total + block.field(x)
        return total

    @staticmethod
    def from_clauses(
        n: int,
        clauses: Sequence[Sequence[int]],
        weights: Sequence[float | Fraction],
        offset: float | Fraction = 0.0,
        dtype: type[np.float64] | type[np.float32] | type[np.int64] = np.float64,
    ) -> "WeightedMaxSat":
        """Return one problem from literals as in DIMACS: 3 is variable number 3 (the first is 1), -3 its negation.

        The energy is the unsatisfied weight of the clauses as given, plus ``offset``. Repeated literals count
        once, clauses with a literal and its negation are always satisfied and left out, empty clauses and
        opposite unit clauses add to the offset. Weights that are integers or fractions are added up without
        rounding.

        Args:
            n: Number of variables, >= 1.
            clauses: One list of literals a clause.
            weights: One weight >= 0 a clause.
            offset: Added to every energy.
            dtype: Of the weights, which are numpy arrays; of int64 the offset is an integer, too.

        >>> problem = WeightedMaxSat.from_clauses(3, [[1, 2], [-1], [-1, -2, 3]], [1.0, 2.0, 4.0])
        >>> problem.energy(np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])).tolist()
        [6.0, 0.0]
        """
        require(len(clauses) == len(weights), "number of weights", len(weights), f"{len(clauses)}, one a clause")
        by_length: dict[int, tuple[list[list[int]], list[float | Fraction]]] = {}
        for number, (clause, weight) in enumerate(zip(clauses, weights, strict=True), start=1):
            require(weight >= 0, f"weight of clause {number}", weight, "a number >= 0")
            literals = sorted(set(clause), key=abs)
            outside = [literal for literal in literals if not 1 <= abs(literal) <= n]
            require(not outside, f"literals of clause {number}", clause, f"integers of size 1 to n = {n}")
            if not any(-literal in literals for literal in literals):
                lists = by_length.setdefault(len(literals), ([], []))
                lists[0].append(literals)
                lists[1].append(weight if isinstance(weight, (int, Fraction)) else float(weight))
        wanted: list[list[float | Fraction]] = [[0] * n, [0] * n]  # total unit weight for x = 0 and for x = 1
        for (literal,), weight in zip(*by_length.pop(1, ([], [])), strict=True):
            wanted[int(literal > 0)][abs(literal) - 1] += weight
        for_0_and_1 = list(zip(*wanted, strict=True))
        always = sum(by_length.pop(0, ([], []))[1]) + sum(map(min, for_0_and_1))
        pairs = _literal_block(2, *by_length.pop(2, ([], [])), dtype)
        return WeightedMaxSat(
            graph=EdgeList(n=n, pairs=pairs.variables),
            weight=pairs.weight,
            first=pairs.polarity[:, 0],
            second=pairs.polarity[:, 1],
            unit=_vector([one - zero for zero, one in for_0_and_1], dtype),
            offset=_vector([offset + always], np.int64 if dtype is np.int64 else np.float64)[0],
            longer=tuple(_literal_block(length, *by_length[length], dtype) for length in sorted(by_length)),
        )


def _vector(numbers: Sequence[float | Fraction], dtype: type[np.generic]) -> Array:
    """Numbers as an array, each rounded once; integers stay what they are."""
    return as_array(np.array([int(x) if dtype is np.int64 else float(x) for x in numbers], dtype))


def _literal_block(
    length: int, clauses: list[list[int]], weights: list[float | Fraction], dtype: type[np.generic]
) -> Clauses:
    """Clauses of one length as arrays."""
    literals = np.array(clauses, np.int64).reshape(len(clauses), length)
    polarity = np.sign(literals).astype(dtype)
    return Clauses(as_array(np.abs(literals) - 1), as_array(polarity), _vector(weights, dtype))


def edge_axes(graph: Graph) -> tuple[int, ...]:
    """The axes of one number a pair, counted from the last."""
    return tuple(range(-len(graph.edge_shape), 0))


def over_states(x: Array, n_axes: int) -> Array:
    """``x`` with an axis of size 1 for the states, before its last ``n_axes`` axes."""
    return x[..., *(None, *(slice(None),) * n_axes)]


def from_qubo(qubo: Qubo) -> WeightedMaxSat:
    r"""Return the equivalent weighted MAX-SAT: unsatisfied weight + offset = energy, for every x.

    A coupling J becomes one clause of weight \|J\| and unit clauses, in either of two ways:

    - J > 0: (not x_i or not x_j); or (x_i or x_j) with the units (not x_i) and (not x_j) of weight J.
    - J < 0: (x_i or not x_j) with the unit (x_j) of weight \|J\|; or (not x_i or x_j) with (x_i).

    The pairs alternate between the two (``graph.alternating()``), so that the units of a variable cancel up to
    its field in the spin form and no unit clause outweighs the clauses that oppose it. The unit weights add up
    with the linear terms; the sign of the sum u picks the literal, and the unsatisfied weight is max(u, 0) - u x.
    """
    xp, weight = namespace(qubo.coupling), abs(qubo.coupling)
    way = cast(alike(qubo.graph.alternating(), weight), weight.dtype)
    second = -xp.broadcast_to(way, weight.shape)
    first = xp.where(qubo.coupling < 0, -second, second)
    # A literal of polarity q is false as (1 + q) / 2 - q x: what a clause costs beyond J x_i x_j is linear.
    false_first, false_second = (1 + first) / 2, (1 + second) / 2
    linear = qubo.graph.scatter(-weight * first * false_second, -weight * second * false_first)
    constant = double(weight * false_first * false_second).sum(edge_axes(qubo.graph))
    unit = linear - qubo.linear
    return WeightedMaxSat(
        graph=qubo.graph,
        weight=weight,
        first=first,
        second=second,
        unit=unit,
        offset=double(qubo.offset) - constant - double(unit).clip(min=0).sum(-1),
    )


def to_qubo(maxsat: WeightedMaxSat) -> Qubo:
    """Return the QUBO whose energy is unsatisfied weight + offset, for every x; inverse of :func:`from_qubo`.

    (1 + q) / 2 - q x is 1 where a literal of polarity q is false, else 0; a clause costs its weight times the
    product of two of these. Clauses of three literals and more take auxiliary variables, see
    :mod:`~memcomp_lightning.problems.rows`: these come after the n variables, and the energy is the one of their
    best values.
    """
    constant_first, constant_second = (1 + maxsat.first) // 2, (1 + maxsat.second) // 2
    linear = maxsat.graph.scatter(
        -maxsat.weight * maxsat.first * constant_second, -maxsat.weight * maxsat.second * constant_first
    )
    constant = wide(maxsat.weight * constant_first * constant_second).sum(edge_axes(maxsat.graph))
    short = Qubo(
        graph=maxsat.graph,
        coupling=maxsat.weight * maxsat.first * maxsat.second,
        linear=linear - maxsat.unit,
        offset=maxsat.offset + constant + wide(maxsat.unit).clip(min=0).sum(-1),
    )
    return plus_rows(short, [block.rows() for block in maxsat.longer]) if maxsat.longer else short


def as_qubo(problem: Qubo | WeightedMaxSat) -> Qubo:
    """The problem as a QUBO, which every solver takes; auxiliary variables of long clauses come last."""
    return problem if isinstance(problem, Qubo) else to_qubo(problem)
