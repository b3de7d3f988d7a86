"""Problems as people have them, with the labels of their variables."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.arrays import as_array
from memcomp_lightning.errors import SettingError, require
from memcomp_lightning.problems.constrained import Constrained
from memcomp_lightning.problems.files.objective import sum_as_qubo
from memcomp_lightning.problems.from_model import constrained_from_model
from memcomp_lightning.problems.maxsat import WeightedMaxSat
from memcomp_lightning.problems.problem import Problem, read_problem
from memcomp_lightning.problems.qubo import Qubo

TAKEN = (
    "a square matrix (numpy, scipy.sparse or torch), a dict {(i, j): q}, spins (h, J), a model of dimod, "
    "a networkx graph (MAX-CUT), an RBM, a file's path, Problem, Constrained, Qubo or WeightedMaxSat"
)

Bits = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Labelled:
    """A problem, and how its states are written where it comes from.

    Attributes:
        problem: What to minimise.
        labels: Of the variables; None where states are arrays.
        spins: Whether values are -1 and 1, and not 0 and 1; of all variables, or of each, ``(n,)`` bool.
        maximised: Whether what is counted there is minus the energy.
    """

    problem: Problem | Constrained | Qubo | WeightedMaxSat
    labels: list[Hashable] | None = None
    spins: bool | Bits = False
    maximised: bool = False

    @staticmethod
    def of(given: Any) -> "Labelled":
        """What ``given`` means, see :func:`memcomp_lightning.solve`.

        Raises:
            SettingError, ProblemFileError: It means nothing.
        """
        if isinstance(given, str | Path):
            given = read_problem(given)
        if isinstance(given, Problem):
            of_spins = getattr(given.objective.counting, "kind", None) == "spin"
            return Labelled(problem=given, spins=of_spins, maximised=given.objective.maximised)
        if isinstance(given, Constrained | Qubo | WeightedMaxSat):
            return Labelled(problem=given)
        if isinstance(given, Mapping) and not hasattr(given, "tocoo"):  # scipy's dok arrays are both
            return _of_pairs("product", {}, given)
        if isinstance(given, tuple) and len(given) == 2:
            return _of_spins(*given)
        if hasattr(given, "quadratic_form"):
            return Labelled(problem=constrained_from_model(given))
        if hasattr(given, "vartype") and hasattr(given, "quadratic"):
            from memcomp_lightning.problems.bqm import from_bqm

            problem, labels = from_bqm(given)
            return Labelled(problem=problem, labels=labels, spins=given.vartype.name == "SPIN")
        if hasattr(given, "constraints") and hasattr(given, "objective"):
            from memcomp_lightning.problems.cqm import from_cqm

            constrained, labels = from_cqm(given)
            spins = np.array([given.vartype(label).name == "SPIN" for label in labels])
            return Labelled(problem=constrained, labels=labels, spins=spins)
        if hasattr(given, "is_directed") and hasattr(given, "edges"):
            return _of_graph(given)
        return Labelled(problem=_of_matrix(given))

    def written(self, x: Bits) -> Any:
        """A state of the problem as it is written there."""
        if isinstance(self.problem, Problem):
            x = self.problem.expand(as_array(x))
        values = np.where(self.spins, 2 * x.astype(np.int64) - 1, x.astype(np.int64))
        return values if self.labels is None else dict(zip(self.labels, values.tolist(), strict=True))

    def read(self, states: Any) -> Bits:
        """A state, or a list of states, that are written so, as ``(n_states, n)``.

        Raises:
            SettingError: Labels, lengths or values are not those of the problem.
        """
        name, labels, n, low = "initial", self.labels, self.problem.n, np.where(self.spins, -1, 0)
        if labels is not None:
            states = [states] if isinstance(states, Mapping) else list(states)
            for state in states:
                fits = isinstance(state, Mapping) and set(state) == set(labels)
                require(fits, name, state, f"a dict with a value for each of the {n} variables, or a list of such")
            states = [[state[label] for label in labels] for state in states]
        values = np.atleast_2d(np.asarray(states))
        require(values.ndim == 2 and values.shape[1] == n, f"shape of {name}", values.shape, f"({n},) or (*, {n})")
        allowed = "values in {" + " or ".join(map(str, np.unique(low).tolist())) + ", 1}"
        require(bool(((values == low) | (values == 1)).all()), name, states, allowed)
        x = values == 1
        return x[:, self.problem.variables] if isinstance(self.problem, Problem) else x


def _of_pairs(kind: Literal["product", "spin"], linear: Mapping[Any, Any], pairs: Mapping[Any, Any]) -> Labelled:
    """A sum over single variables and over pairs, by label."""
    for pair in pairs:
        require(isinstance(pair, tuple) and len(pair) == 2, "key", pair, "a pair of variables (i, j)")
    labels = list(dict.fromkeys([*linear, *chain.from_iterable(pairs)]))
    position = {label: k for k, label in enumerate(labels)}
    ends = [(position[i], position[j]) for i, j in pairs]
    ends += [(position[i], position[i]) for i in linear]
    return _of_sum(kind, labels, ends, [*pairs.values(), *linear.values()])


def _of_sum(kind: Literal["product", "cut", "spin"], labels: list[Any], ends: list[Any], numbers: Any) -> Labelled:
    """A sum over listed pairs; of a cut, minus the sum."""
    require(bool(labels), "number of variables", 0, "at least one")
    i, j = np.array(ends, np.int64).reshape(-1, 2).T
    try:
        values = np.array([*numbers, 0])
        values = values if _as_integers(values, _GROWTH[kind]) else values.astype(np.float64)
    except (TypeError, ValueError):
        raise SettingError("The problem's numbers are not all real numbers.") from None
    problem = sum_as_qubo(kind, len(labels), i, j, -values if kind == "cut" else values)
    return Labelled(problem=problem, labels=labels, spins=kind == "spin", maximised=kind == "cut")


def _of_spins(h: Any, couplings: Any) -> Labelled:
    """``h . s + sum J_ij s_i s_j`` of s in {-1, 1}: two dicts by label, or a vector with a dict or a matrix."""
    if not isinstance(couplings, Mapping):
        matrix = np.asarray(couplings.toarray() if hasattr(couplings, "toarray") else couplings)
        require(matrix.ndim == 2, "shape of J", matrix.shape, "(n, n), or a dict {(i, j): J_ij}")
        couplings = {(int(i), int(j)): matrix[i, j] for i, j in np.argwhere(matrix)}
    own = [pair for pair in couplings if isinstance(pair, tuple) and len(set(pair)) == 1]
    require(not own, "J's entry", own and own[0], "pairs of two different spins")
    if isinstance(h, Mapping):
        return _of_pairs("spin", h, couplings)
    fields = np.asarray(h)
    require(fields.ndim == 1, "shape of h", fields.shape, "(n,), or a dict by label")
    found = _of_pairs("spin", dict(enumerate(fields.tolist())), couplings)
    labels = found.labels or []
    beyond = labels[len(fields) :]
    require(not beyond, "J's index", beyond and beyond[0], f"integers from 0 to n - 1 = {len(fields) - 1}")
    return replace(found, labels=None)


def _of_graph(graph: Any) -> Labelled:
    """The largest cut, by the edges' ``weight``, 1 where there is none."""
    require(not graph.is_directed(), "problem", "a directed graph", "an undirected one", "graph.to_undirected()")
    labels = list(graph.nodes)
    position = {label: k for k, label in enumerate(labels)}
    edges = list(graph.edges(data="weight", default=1))
    ends = [(position[i], position[j]) for i, j, _ in edges]
    return _of_sum("cut", labels, ends, [weight for _, _, weight in edges])


def _of_matrix(matrix: Any) -> Qubo:
    """``x' Q x`` of a square matrix of any library."""
    tensor = hasattr(matrix, "detach")
    known = isinstance(matrix, np.ndarray) or hasattr(matrix, "tocoo") or tensor
    matrix = np.asarray(matrix) if isinstance(matrix, np.matrix) else matrix
    require(known, "problem", type(matrix).__name__, TAKEN)
    shape = tuple(matrix.shape)
    square = len(shape) == 2 and shape[0] == shape[1] > 0
    require(square, "shape of the problem", shape, "(n, n), one square matrix")
    if tensor:
        matrix = matrix.detach()
        entries = matrix.to_sparse_coo().coalesce().values() if "sparse" in str(matrix.layout) else matrix
        whole = not matrix.is_floating_point() and _as_integers(entries.cpu().numpy())
        return Qubo.from_matrix(matrix.long()) if whole else Qubo.from_matrix(matrix).floating()
    require(matrix.dtype.kind in "biuf", "type of the problem's numbers", str(matrix.dtype), "real numbers")
    whole = _as_integers(matrix.tocoo().data if hasattr(matrix, "tocoo") else matrix)
    return Qubo.from_matrix(matrix.astype(np.int64 if whole else np.float64))


def _as_integers(values: NDArray[Any], growth: int = 1) -> bool:
    """Whether these are whole numbers whose sums, with this growth, float64 rounds and int64 holds."""
    if np.asarray(values).dtype.kind not in "iu":
        return False
    size = growth * float(np.abs(np.asarray(values).astype(np.float64)).sum())
    return 2.0**53 < size < 2.0**62


_GROWTH = {"product": 1, "cut": 4, "spin": 9}
"""What the sizes of the numbers of a QUBO add up to, of a pair's number 1: of spins 4, 2, 2 and 1."""
