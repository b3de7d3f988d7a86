"""Quadratic unconstrained binary optimisation."""

from dataclasses import dataclass

from memcomp_lightning.arrays import AnyArray, Array, add_up, alike, as_array, cast, double, is_floating, namespace
from memcomp_lightning.errors import require
from memcomp_lightning.problems.graph import EdgeList, Graph


@dataclass(frozen=True, slots=True, eq=False)
class Qubo:
    r"""Minimise ``offset + linear . x + \sum_{pairs} coupling x_i x_j`` over x in {0, 1}^n.

    Its numbers are numpy arrays or torch tensors, and so are the solvers' answers. Leading axes ``*problems`` hold
    independent problems of one graph. Numbers of int64 are added up as integers:
    ``BruteForce`` compares their sums without rounding.

    Attributes:
        graph: The coupled pairs and the layout of ``coupling``.
        coupling: ``(*problems, *graph.edge_shape)``.
        linear: ``(*problems, n)``.
        offset: ``(*problems,)``, the energy of x = 0.
    """

    graph: Graph
    coupling: Array
    linear: Array
    offset: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "graph", self.graph.alike(self.linear))
        coupling, linear, offset = (tuple(part.shape) for part in (self.coupling, self.linear, self.offset))
        edge_shape, axes = self.graph.edge_shape, len(coupling) - len(self.graph.edge_shape)
        allowed = f"(*problems, {', '.join(map(str, edge_shape))})"
        require(coupling[axes:] == edge_shape, "coupling shape", coupling, allowed)
        problems = coupling[:axes]
        require(linear == (*problems, self.n), "linear shape", linear, f"{(*problems, self.n)}")
        require(offset == problems, "offset shape", offset, f"{problems}")
        names, isfinite = ("coupling", "linear", "offset"), namespace(self.linear).isfinite
        finite = [isfinite(getattr(self, name)).all() for name in names]
        if not bool(finite[0] & finite[1] & finite[2]):  # at once: a device would be waited for three times
            name = next(name for name, one in zip(names, finite, strict=True) if not bool(one))
            require(False, name, "an array with NaN or infinite entries", "finite numbers")

    @property
    def n(self) -> int:
        """Number of variables."""
        return self.graph.n

    @property
    def problems(self) -> tuple[int, ...]:
        """Leading axes of independent problems."""
        return tuple(self.offset.shape)

    def double(self) -> "Qubo":
        """The same problem in float64."""
        return Qubo(self.graph, double(self.coupling), double(self.linear), double(self.offset))

    def floating(self) -> "Qubo":
        """Itself, or in float64 where it is of whole numbers: what searches by random steps work with."""
        return self if is_floating(self.linear) else self.double()

    def alike(self, like: AnyArray) -> "Qubo":
        """The same problem in the library and on the device of ``like``: a tensor, as to solve it on a GPU."""
        numbers = (alike(part, like) for part in (self.coupling, self.linear, self.offset))
        return Qubo(self.graph.alike(like), *numbers)

    def energy(self, x: Array) -> Array:
        """Energy in float64, ``(*problems, n_states)``, of states ``x (*problems, n_states, n)`` in [0, 1].

        Of a problem in int64 the energy is an integer, and the states are in {0, 1}.
        """
        linear, coupling, offset = wide(self.linear), wide(self.coupling), wide(self.offset)
        x = cast(alike(x, linear), linear.dtype)
        own = (x @ linear[..., None])[..., 0]
        return offset[..., None] + own + self.graph.quadratic(coupling, x)

    def rounds(self) -> Array:
        """Whether float64 rounds sums of these numbers by as much as the smallest of them: ``(*problems,)`` bool.

        Sums of integers are exact up to 2^53, those of others rounded by 2^-53 of what they reach.
        """
        xp = namespace(self.linear)
        if self.linear.dtype == xp.int64:
            return xp.zeros_like(self.offset, dtype=xp.bool)
        parts = [self.coupling.reshape(*self.problems, -1), self.linear, self.offset[..., None]]
        numbers = xp.concat([double(part) for part in parts], axis=-1)
        whole, total = (numbers == xp.round(numbers)).all(-1), abs(numbers).sum(-1)
        smallest = xp.min(xp.where(numbers == 0, xp.inf, abs(numbers)), axis=-1)
        return xp.where(whole, total > 2.0**53, total * 2.0**-50 > smallest)

    def field(self, x: Array) -> Array:
        """Energy of x_i = 1 less energy of x_i = 0 for each variable, ``(*problems, n_states, n)``."""
        return self.linear[..., None, :] + self.graph.field(self.coupling, x)

    @staticmethod
    def from_matrix(matrix: AnyArray, offset: AnyArray | None = None) -> "Qubo":
        """Return the problem ``x' Q x + offset`` of a square matrix, symmetric or not.

        Args:
            matrix: ``(*problems, n, n)``; entries (i, j) and (j, i) add up, the diagonal is the linear part.
                One problem may also be sparse, of scipy or torch.
            offset: ``(*problems,)``; None is zero.

        >>> import numpy as np
        >>> Qubo.from_matrix(np.array([[1.0, -3.0], [0.0, 1.0]])).energy(np.ones((1, 2))).tolist()
        [-1.0]
        """
        n, matrix = matrix.shape[-1], as_array(matrix)
        square = matrix.ndim >= 2 and matrix.shape[-2] == n
        require(square, "matrix shape", tuple(matrix.shape), "(*problems, n, n)")
        if hasattr(matrix, "tocoo"):
            coo = matrix.tocoo()
            rows, columns = (index.astype("int64") for index in (coo.row, coo.col))
            return Qubo.from_coo(n, rows, columns, coo.data, offset)
        if "sparse" in str(getattr(matrix, "layout", "")):
            require(matrix.ndim == 2, "sparse matrix shape", tuple(matrix.shape), "(n, n), one problem")
            coo = matrix.to_sparse_coo().coalesce()
            return Qubo.from_coo(n, coo.indices()[0], coo.indices()[1], coo.values(), offset)
        used = (matrix != 0).reshape(-1, n, n).any(0)
        rows, columns = namespace(matrix).nonzero(used)
        return Qubo.from_coo(n, rows, columns, matrix[..., rows, columns], offset)

    @staticmethod
    def from_coo(
        n: int, rows: AnyArray, columns: AnyArray, values: AnyArray, offset: AnyArray | None = None
    ) -> "Qubo":
        """Return the problem ``sum_k value_k x_row_k x_column_k + offset`` with memory linear in the entries.

        Args:
            n: Number of variables, >= 1.
            rows: ``(n_entries,)`` int64 in [0, n).
            columns: ``(n_entries,)`` int64 in [0, n); where it equals the row the entry is linear.
            values: ``(*problems, n_entries)``; entries of the same pair, in either order, add up.
            offset: ``(*problems,)``; None is zero.

        >>> import numpy as np
        >>> edges = np.array([0, 1, 1]), np.array([1, 0, 1])
        >>> Qubo.from_coo(2, *edges, np.array([-1.0, -2.0, 1.0])).energy(np.ones((1, 2))).tolist()
        [-2.0]
        """
        rows, columns, values = as_array(rows), as_array(columns), as_array(values)
        for name, index in (("rows", rows), ("columns", columns)):
            fits = index.shape == values.shape[-1:] and bool(((index >= 0) & (index < n)).all())
            least, most = (index.min(), index.max()) if len(index) else ("-", "-")
            allowed = f"{values.shape[-1]} integers, one a value, from 0 to n - 1 = {n - 1}"
            require(fits, name, f"shape {tuple(index.shape)}, from {least} to {most}", allowed)
        xp, diagonal = namespace(values), rows == columns
        first, second = xp.minimum(rows, columns)[~diagonal], xp.maximum(rows, columns)[~diagonal]
        keys, position = xp.unique_inverse(first * n + second)
        return Qubo(
            graph=EdgeList(n=n, pairs=xp.stack((keys // n, keys % n), axis=-1)),
            coupling=add_up(values[..., ~diagonal], position, len(keys)),
            linear=add_up(values[..., diagonal], rows[diagonal], n),
            offset=xp.zeros_like(values.sum(-1)) if offset is None else as_array(offset),
        )

    def to_matrix(self) -> Array:
        """The upper triangular matrix Q of ``x' Q x + offset``, ``(*problems, n, n)``."""
        xp = namespace(self.linear)
        edges = alike(self.graph.edges(), self.linear)
        matrix = self.linear[..., None] * xp.eye(self.n, dtype=self.linear.dtype, device=self.linear.device)
        matrix[..., edges[:, 0], edges[:, 1]] += self.coupling.reshape(*self.problems, -1)
        return matrix


def wide(x: Array) -> Array:
    """In float64, or int64 as it is."""
    return x if x.dtype == namespace(x).int64 else double(x)
