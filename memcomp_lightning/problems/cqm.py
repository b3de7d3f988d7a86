"""Constrained quadratic models of dimod, whose variables have two values, as problems with constraints."""

import math
from fractions import Fraction
from typing import Any

import numpy as np

from memcomp_lightning.errors import require
from memcomp_lightning.optional import WITHOUT_DIMOD
from memcomp_lightning.problems.constrained import Constrained, Linear
from memcomp_lightning.problems.qubo import Qubo

try:
    from dimod import ConstrainedQuadraticModel, Vartype
except ModuleNotFoundError:
    raise ModuleNotFoundError(WITHOUT_DIMOD) from None

_TWO_VALUES = {Vartype.BINARY: (1, 0), Vartype.SPIN: (2, -1)}
"""A variable of the model is factor x + shift, with x in {0, 1}."""


def from_cqm(cqm: ConstrainedQuadraticModel) -> tuple[Constrained, list[Any]]:
    """A model with binary and spin variables as a problem, and its variables in the order of the problem's.

    Constraints may have decimal fractions as coefficients: they are scaled to whole numbers.

    Raises:
        SettingError: The model has no variables, one that is an integer or a real, a constraint that is quadratic
            or soft, or one whose numbers have so many digits that they are beyond 2^31 as whole numbers.
    """
    variables = list(cqm.variables)
    require(bool(variables), "variables", variables, "a model with at least one variable")
    for name in variables:
        kind = cqm.vartype(name)
        remedy = "Write an integer as a sum of binary variables."
        require(kind in _TWO_VALUES, f"vartype of {name!r}", kind.name, "BINARY or SPIN", remedy)
    number = {name: position for position, name in enumerate(variables)}
    form = [_TWO_VALUES[cqm.vartype(name)] for name in variables]
    rows = [_linear(label, constraint, number, form) for label, constraint in cqm.constraints.items()]
    entries, offset = list[tuple[int, int, float]](), float(cqm.objective.offset)
    for name, bias in cqm.objective.iter_linear():
        i = number[name]
        factor, shift = form[i]
        entries.append((i, i, factor * bias))
        offset += shift * bias
    for one, other, bias in cqm.objective.iter_quadratic():
        i, j = number[one], number[other]
        (a, b), (c, d) = form[i], form[j]
        entries += [(i, j, a * c * bias), (i, i, a * d * bias), (j, j, b * c * bias)]
        offset += b * d * bias
    first, second = np.array([entry[:2] for entry in entries], np.int64).reshape(-1, 2).T
    values = np.array([entry[2] for entry in entries], np.float64)
    objective = Qubo.from_coo(len(variables), first, second, values, np.array(offset))
    return Constrained.of(objective, rows), variables


def _linear(label: Any, constraint: Any, number: dict[Any, int], form: list[tuple[int, int]]) -> Linear:
    """One constraint, in whole numbers of the problem's variables."""
    left, name = constraint.lhs, f"constraint {label!r}"
    require(left.is_linear(), name, "quadratic", "a linear constraint")
    require(not left.is_soft(), name, "soft", "a hard one", "Add what it costs to the objective.")
    exact = {variable: Fraction(repr(float(bias))) for variable, bias in left.iter_linear()}
    bound = Fraction(repr(float(constraint.rhs))) - Fraction(repr(float(left.offset)))
    unit = math.lcm(bound.denominator, *(bias.denominator for bias in exact.values()))
    coefficients = dict[int, int]()
    for variable, bias in exact.items():
        factor, shift = form[number[variable]]
        coefficients[number[variable]] = int(factor * bias * unit)
        bound -= shift * bias
    fits = sum(map(abs, coefficients.values())) < 2**31
    require(fits, f"numbers of {name}", f"whole numbers of 1/{unit}", "numbers with fewer digits")
    sense, limit = constraint.sense.name, int(bound * unit)
    return Linear(coefficients, None if sense == "Le" else limit, None if sense == "Ge" else limit)
