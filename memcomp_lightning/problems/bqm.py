"""Binary quadratic models of dimod as problems, and problems as such models."""

from typing import Any

import numpy as np

from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.errors import require
from memcomp_lightning.optional import WITHOUT_DIMOD
from memcomp_lightning.problems.qubo import Qubo

try:
    from dimod import BinaryQuadraticModel, Vartype
except ModuleNotFoundError:
    raise ModuleNotFoundError(WITHOUT_DIMOD) from None


def to_bqm(qubo: Qubo) -> BinaryQuadraticModel:
    """One problem as a binary quadratic model with the variables 0 to n - 1.

    784 x 500 take 20 ms, as long as writing new biases into a model that exists: dimod looks for the place of
    each coupling either way.

    Raises:
        SettingError: Several problems at once.

    >>> float(to_bqm(Qubo.from_matrix(np.array([[1.0, -3.0], [0.0, 1.0]]))).energy({0: 1, 1: 1}))
    -1.0
    """
    require(qubo.problems == (), "problems", qubo.problems, "one problem, without leading axes")
    edges = to_numpy(qubo.graph.edges())
    linear, coupling = (to_numpy(part).astype(np.float64).ravel() for part in (qubo.linear, qubo.coupling))
    quadratic = (edges[:, 0], edges[:, 1], coupling)
    return BinaryQuadraticModel.from_numpy_vectors(linear, quadratic, float(qubo.offset), Vartype.BINARY)


def from_bqm(bqm: BinaryQuadraticModel) -> tuple[Qubo, list[Any]]:
    """A model of either vartype as a problem, and its variables in the order of the problem's.

    Raises:
        SettingError: The model has no variables.
    """
    variables = list(bqm.variables)
    require(bool(variables), "variables", variables, "a model with at least one variable")
    vectors: Any = bqm.binary.to_numpy_vectors(variable_order=variables)
    linear, (rows, columns, values), offset = vectors
    units = np.arange(len(variables))
    first, second = (np.concatenate((units, end)).astype(np.int64) for end in (rows, columns))
    numbers = np.concatenate((linear, values)).astype(np.float64)
    return Qubo.from_coo(len(units), first, second, numbers, np.array(offset, np.float64)), variables
