"""Quadratic unconstrained binary optimisation."""

from dataclasses import dataclass

import torch
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.problems.graph import EdgeList, Graph


@dataclass(frozen=True, slots=True, eq=False)
class Qubo:
    r"""Minimise ``offset + linear . x + \sum_{pairs} coupling x_i x_j`` over x in {0, 1}^n.

    Leading axes ``*problems`` hold independent problems of one graph. Numbers of int64 are added up as integers:
    ``BruteForce`` compares their sums without rounding.

    Attributes:
        graph: The coupled pairs and the layout of ``coupling``.
        coupling: ``(*problems, *graph.edge_shape)``.
        linear: ``(*problems, n)``.
        offset: ``(*problems,)``, the energy of x = 0.
    """

    graph: Graph
    coupling: Tensor
    linear: Tensor
    offset: Tensor

    def __post_init__(self) -> None:
        edge_shape, n = self.graph.edge_shape, self.graph.n
        axes = len(edge_shape)
        require(
            tuple(self.coupling.shape[self.coupling.ndim - axes :]) == edge_shape,
            "coupling shape",
            tuple(self.coupling.shape),
            f"(*problems, {', '.join(map(str, edge_shape))})",
        )
        problems = tuple(self.coupling.shape[: self.coupling.ndim - axes])
        require(
            tuple(self.linear.shape) == (*problems, n),
            "linear shape",
            tuple(self.linear.shape),
            f"{(*problems, n)}",
        )
        require(tuple(self.offset.shape) == problems, "offset shape", tuple(self.offset.shape), f"{problems}")
        for name, tensor in (("coupling", self.coupling), ("linear", self.linear), ("offset", self.offset)):
            require(bool(tensor.isfinite().all()), name, "a tensor with NaN or infinite entries", "finite numbers")

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
        return Qubo(self.graph, self.coupling.double(), self.linear.double(), self.offset.double())

    def energy(self, x: Tensor) -> Tensor:
        """Energy in float64, ``(*problems, n_states)``, of states ``x (*problems, n_states, n)`` in [0, 1].

        Of a problem in int64 the energy is an integer, and the states are in {0, 1}.
        """
        linear, coupling, offset = wide(self.linear), wide(self.coupling), wide(self.offset)
        x = x.to(linear.dtype)
        own = (x @ linear.unsqueeze(-1)).squeeze(-1)
        return offset.unsqueeze(-1) + own + self.graph.quadratic(coupling, x)

    def rounds(self) -> Tensor:
        """Whether the numbers are integers with sums beyond 2^53, which float64 rounds: ``(*problems,)`` bool."""
        if self.linear.dtype == torch.int64:
            return torch.zeros(self.problems, dtype=torch.bool, device=self.linear.device)
        parts = [self.coupling.reshape(*self.problems, -1), self.linear, self.offset.unsqueeze(-1)]
        numbers = torch.cat([part.double() for part in parts], dim=-1)
        return (numbers == numbers.round()).all(-1) & (numbers.abs().sum(-1) > 2.0**53)

    def field(self, x: Tensor) -> Tensor:
        """Energy of x_i = 1 less energy of x_i = 0 for each variable, ``(*problems, n_states, n)``."""
        return self.linear.unsqueeze(-2) + self.graph.field(self.coupling, x)

    @staticmethod
    def from_matrix(matrix: Tensor, offset: Tensor | None = None) -> "Qubo":
        """Return the problem ``x' Q x + offset`` of a square matrix, symmetric or not.

        Args:
            matrix: ``(*problems, n, n)``; entries (i, j) and (j, i) add up, the diagonal is the linear part.
                One problem may also be a sparse torch tensor (COO, CSR, CSC).
            offset: ``(*problems,)``; None is zero.

        >>> Qubo.from_matrix(torch.tensor([[1.0, -3.0], [0.0, 1.0]])).energy(torch.ones(1, 2)).tolist()
        [-1.0]
        """
        n = matrix.shape[-1]
        require(
            matrix.ndim >= 2 and matrix.shape[-2] == n,
            "matrix shape",
            tuple(matrix.shape),
            "(*problems, n, n)",
        )
        if matrix.layout != torch.strided:
            require(matrix.ndim == 2, "sparse matrix shape", tuple(matrix.shape), "(n, n), one problem")
            coo = matrix.to_sparse_coo().coalesce()
            return Qubo.from_coo(n, coo.indices()[0], coo.indices()[1], coo.values(), offset)
        used = (matrix != 0).reshape(-1, n, n).any(0)
        rows, columns = used.nonzero(as_tuple=True)
        return Qubo.from_coo(n, rows, columns, matrix[..., rows, columns], offset)

    @staticmethod
    def from_coo(n: int, rows: Tensor, columns: Tensor, values: Tensor, offset: Tensor | None = None) -> "Qubo":
        """Return the problem ``sum_k value_k x_row_k x_column_k + offset`` with memory linear in the entries.

        Args:
            n: Number of variables, >= 1.
            rows: ``(n_entries,)`` int64 in [0, n).
            columns: ``(n_entries,)`` int64 in [0, n); where it equals the row the entry is linear.
            values: ``(*problems, n_entries)``; entries of the same pair, in either order, add up.
            offset: ``(*problems,)``; None is zero.

        >>> edges = torch.tensor([0, 1, 1]), torch.tensor([1, 0, 1])
        >>> Qubo.from_coo(2, *edges, torch.tensor([-1.0, -2.0, 1.0])).energy(torch.ones(1, 2)).tolist()
        [-2.0]
        """
        for name, index in (("rows", rows), ("columns", columns)):
            require(
                index.shape == values.shape[-1:] and bool(((index >= 0) & (index < n)).all()),
                name,
                f"shape {tuple(index.shape)}, from {index.min() if index.numel() else '-'} "
                f"to {index.max() if index.numel() else '-'}",
                f"{values.shape[-1]} integers, one a value, from 0 to n - 1 = {n - 1}",
            )
        diagonal = rows == columns
        problems = values.shape[:-1]
        linear = values.new_zeros(*problems, n).index_add_(-1, rows[diagonal], values[..., diagonal])
        first, second = torch.minimum(rows, columns)[~diagonal], torch.maximum(rows, columns)[~diagonal]
        keys, position = (first * n + second).unique(return_inverse=True)
        coupling = values.new_zeros(*problems, keys.shape[0]).index_add_(-1, position, values[..., ~diagonal])
        return Qubo(
            graph=EdgeList(n=n, pairs=torch.stack((keys // n, keys % n), dim=-1)),
            coupling=coupling,
            linear=linear,
            offset=values.new_zeros(problems) if offset is None else offset,
        )

    def to_matrix(self) -> Tensor:
        """The upper triangular matrix Q of ``x' Q x + offset``, ``(*problems, n, n)``."""
        matrix = torch.diag_embed(self.linear)
        edges = self.graph.edges().to(self.linear.device)
        flat = self.coupling.reshape(*self.problems, -1)
        matrix[..., edges[:, 0], edges[:, 1]] += flat
        return matrix


def wide(x: Tensor) -> Tensor:
    """In float64, or int64 as it is."""
    return x if x.dtype == torch.int64 else x.double()
