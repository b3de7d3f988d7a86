"""Weighted MAX-SAT: clauses of any length, and the exact equivalence of its two-literal form with QUBO."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import torch
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.problems.graph import EdgeList, Graph
from memcomp_lightning.problems.qubo import Qubo, wide


@dataclass(frozen=True, slots=True, eq=False)
class Clauses:
    """Clauses of one length, three literals or more.

    Attributes:
        variables: ``(n_clauses, length)`` int64, the variables of a clause differ.
        polarity: ``(n_clauses, length)``, +1 for a variable, -1 for its negation.
        weight: Clause weights >= 0, ``(*problems, n_clauses)``.
    """

    variables: Tensor
    polarity: Tensor
    weight: Tensor

    def unsatisfied_weight(self, x: Tensor) -> Tensor:
        """Total weight of unsatisfied clauses in float64, ``(*problems, n_states)``, of states in {0, 1}."""
        false = (x[..., self.variables] > 0.5) != (self.polarity > 0)
        return (false.all(-1).double() @ self.weight.double().unsqueeze(-1)).squeeze(-1)

    def field(self, x: Tensor) -> Tensor:
        """Unsatisfied weight of x_i = 1 less that of x_i = 0, ``(*problems, n_states, n)``."""
        false = (x[..., self.variables] > 0.5) != (self.polarity > 0)
        # A literal decides its clause where all others are false.
        decides = (~false).sum(-1, keepdim=True) == (~false).int()
        push = -self.polarity.double() * self.weight.double()[..., None, :, None] * decides
        total = torch.zeros(x.shape, dtype=torch.float64, device=x.device)
        return total.index_add_(-1, self.variables.flatten(), push.flatten(-2))


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
    weight: Tensor
    first: Tensor
    second: Tensor
    unit: Tensor
    offset: Tensor
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

    def energy(self, x: Tensor) -> Tensor:
        """Unsatisfied weight + offset in float64, ``(*problems, n_states)``, of ``x (*problems, n_states, n)``."""
        return self.unsatisfied_weight(x) + self.offset.double().unsqueeze(-1)

    def unsatisfied_weight(self, x: Tensor) -> Tensor:
        """Total weight of unsatisfied clauses in float64, ``(*problems, n_states)``, by its definition.

        Args:
            x: States ``(*problems, n_states, n)`` in {0, 1}.
        """
        first, second = self.graph.gather(x.double())
        over_states = -1 - len(self.graph.edge_shape)
        false = [
            (1 - (2 * value - 1) * polarity.unsqueeze(over_states)) / 2
            for value, polarity in ((first, self.first), (second, self.second))
        ]
        axes = tuple(range(-len(self.graph.edge_shape), 0))
        clauses = (self.weight.double().unsqueeze(over_states) * false[0] * false[1]).sum(axes)
        unit = self.unit.double().unsqueeze(-2)
        units = (unit.abs() * ((x > 0.5) != (unit > 0))).sum(-1)
        return clauses + units + sum(block.unsatisfied_weight(x) for block in self.longer)

    def field(self, x: Tensor) -> Tensor:
        """Energy of x_i = 1 less energy of x_i = 0 in float64, ``(*problems, n_states, n)``, of binary states."""
        first, second = self.graph.gather(2 * x.double() - 1)
        over_states = -1 - len(self.graph.edge_shape)
        polarity = [q.double().unsqueeze(over_states) for q in (self.first, self.second)]
        false = [(1 - q * spin) / 2 for q, spin in zip(polarity, (first, second), strict=True)]
        weight = self.weight.double().unsqueeze(over_states)
        total = self.graph.scatter(-weight * polarity[0] * false[1], -weight * polarity[1] * false[0])
        total = total - self.unit.double().unsqueeze(-2)
        for block in self.longer:
            total = total + block.field(x)
        return total

    @staticmethod
    def from_clauses(
        n: int,
        clauses: Sequence[Sequence[int]],
        weights: Sequence[float | Fraction],
        offset: float | Fraction = 0.0,
        dtype: torch.dtype = torch.float64,
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
            dtype: Of the weights; of int64 the offset is an integer, too.

        >>> problem = WeightedMaxSat.from_clauses(3, [[1, 2], [-1], [-1, -2, 3]], [1.0, 2.0, 4.0])
        >>> problem.energy(torch.tensor([[1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])).tolist()
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
            offset=_vector([offset + always], dtype if not dtype.is_floating_point else torch.float64)[0],
            longer=tuple(_literal_block(length, *by_length[length], dtype) for length in sorted(by_length)),
        )


def _vector(numbers: Sequence[float | Fraction], dtype: torch.dtype) -> Tensor:
    """Numbers as a tensor, each rounded once; integers stay what they are."""
    return torch.tensor([float(x) if dtype.is_floating_point else int(x) for x in numbers], dtype=dtype)


def _literal_block(
    length: int, clauses: list[list[int]], weights: list[float | Fraction], dtype: torch.dtype
) -> Clauses:
    """Clauses of one length as tensors."""
    literals = torch.tensor(clauses, dtype=torch.int64).reshape(len(clauses), length)
    weight = _vector(weights, dtype)
    return Clauses(variables=literals.abs() - 1, polarity=literals.sign().to(weight.dtype), weight=weight)


def from_qubo(qubo: Qubo) -> WeightedMaxSat:
    r"""Return the equivalent weighted MAX-SAT: unsatisfied weight + offset = energy, for every x.

    A coupling J becomes one clause of weight \|J\| and unit clauses, in either of two ways:

    - J > 0: (not x_i or not x_j); or (x_i or x_j) with the units (not x_i) and (not x_j) of weight J.
    - J < 0: (x_i or not x_j) with the unit (x_j) of weight \|J\|; or (not x_i or x_j) with (x_i).

    The pairs alternate between the two (``graph.alternating()``), so that the units of a variable cancel up to
    its field in the spin form and no unit clause outweighs the clauses that oppose it. The unit weights add up
    with the linear terms; the sign of the sum u picks the literal, and the unsatisfied weight is max(u, 0) - u x.
    """
    way = qubo.graph.alternating().to(qubo.coupling)
    weight = qubo.coupling.abs()
    second = -way.expand(weight.shape)
    first = torch.where(qubo.coupling < 0, -second, second)
    # A literal of polarity q is false as (1 + q) / 2 - q x: what a clause costs beyond J x_i x_j is linear.
    false_first, false_second = (1 + first) / 2, (1 + second) / 2
    linear = qubo.graph.scatter(-weight * first * false_second, -weight * second * false_first)
    constant = (weight * false_first * false_second).double().sum(tuple(range(-len(qubo.graph.edge_shape), 0)))
    unit = linear - qubo.linear
    return WeightedMaxSat(
        graph=qubo.graph,
        weight=weight,
        first=first,
        second=second,
        unit=unit,
        offset=qubo.offset.double() - constant - unit.double().clamp(min=0).sum(-1),
    )


def to_qubo(maxsat: WeightedMaxSat) -> Qubo:
    """Return the QUBO whose energy is unsatisfied weight + offset, for every x; inverse of :func:`from_qubo`.

    (1 + q) / 2 - q x is 1 where a literal of polarity q is false, else 0; a clause costs its weight times the
    product of two of these.

    Raises:
        SettingError: The problem has clauses of three literals or more.
    """
    require(
        not maxsat.longer,
        "longest clause",
        max((block.variables.shape[-1] for block in maxsat.longer), default=2),
        "at most 2 literals",
        "Longer clauses are no QUBO without auxiliary variables: solve them with DmmSolver(field=ClauseField()).",
    )
    axes = tuple(range(-len(maxsat.graph.edge_shape), 0))
    constant_first, constant_second = (1 + maxsat.first) // 2, (1 + maxsat.second) // 2
    linear = maxsat.graph.scatter(
        -maxsat.weight * maxsat.first * constant_second, -maxsat.weight * maxsat.second * constant_first
    )
    constant = wide(maxsat.weight * constant_first * constant_second).sum(axes)
    return Qubo(
        graph=maxsat.graph,
        coupling=maxsat.weight * maxsat.first * maxsat.second,
        linear=linear - maxsat.unit,
        offset=maxsat.offset + constant + wide(maxsat.unit).clamp(min=0).sum(-1),
    )
