"""Weighted MAX-SAT with clauses of two literals and unit clauses, and its exact equivalence with QUBO."""

from dataclasses import dataclass

import torch
from torch import Tensor

from memcomp_lightning.qubo.graph import Graph
from memcomp_lightning.qubo.qubo import Qubo


@dataclass(frozen=True, slots=True, eq=False)
class WeightedMaxSat:
    r"""Minimise the total weight of unsatisfied clauses.

    One clause a pair of the graph, ``(first literal or second literal)``, and one unit clause a variable. A
    literal is the variable (polarity +1) or its negation (polarity -1).

    Attributes:
        graph: The pairs of variables that share a clause.
        weight: Clause weights >= 0, ``(*problems, *graph.edge_shape)``.
        first: Polarity of the first literal, +1 or -1, broadcastable to ``weight``.
        second: Polarity of the second literal, likewise.
        unit: Signed weights of the unit clauses, ``(*problems, n)``: > 0 asks for x = 1, < 0 for x = 0.
        offset: ``(*problems,)``; unsatisfied weight + offset is the energy of the QUBO.
    """

    graph: Graph
    weight: Tensor
    first: Tensor
    second: Tensor
    unit: Tensor
    offset: Tensor

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
        return clauses + units


def from_qubo(qubo: Qubo) -> WeightedMaxSat:
    r"""Return the equivalent weighted MAX-SAT: unsatisfied weight + offset = energy, for every x.

    A coupling J > 0 becomes the clause (not x_i or not x_j) of weight J. A coupling J < 0 becomes
    (x_i or not x_j) of weight \|J\| and the unit clause (x_j) of weight \|J\|. The unit weights of a
    variable add up with its linear term; the sign of the sum u picks the literal, and the unsatisfied unit
    weight is max(u, 0) - u x.
    """
    attractive = (-qubo.coupling).clamp(min=0)
    unit = qubo.graph.scatter(torch.zeros_like(attractive), attractive) - qubo.linear
    ones = torch.ones_like(qubo.coupling)
    return WeightedMaxSat(
        graph=qubo.graph,
        weight=qubo.coupling.abs(),
        first=torch.where(qubo.coupling < 0, ones, -ones),
        second=-ones[(slice(0, 1),) * ones.ndim],
        unit=unit,
        offset=qubo.offset.double() - unit.double().clamp(min=0).sum(-1),
    )


def to_qubo(maxsat: WeightedMaxSat) -> Qubo:
    """Return the QUBO whose energy is unsatisfied weight + offset, for every x; inverse of :func:`from_qubo`.

    A literal of polarity q is false as (1 + q) / 2 - q x; a clause costs the product of two of these.
    """
    axes = tuple(range(-len(maxsat.graph.edge_shape), 0))
    constant_first, constant_second = (1 + maxsat.first) / 2, (1 + maxsat.second) / 2
    linear = maxsat.graph.scatter(
        -maxsat.weight * maxsat.first * constant_second, -maxsat.weight * maxsat.second * constant_first
    )
    constant = (maxsat.weight * constant_first * constant_second).double().sum(axes)
    return Qubo(
        graph=maxsat.graph,
        coupling=maxsat.weight * maxsat.first * maxsat.second,
        linear=linear - maxsat.unit,
        offset=maxsat.offset + constant + maxsat.unit.double().clamp(min=0).sum(-1),
    )
