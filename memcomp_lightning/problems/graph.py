"""Which pairs of variables are coupled, and the tensor layout of their couplings.

A coupling is one number a pair. The layouts here let the same equations run on a matrix (RBM) or on a list
of pairs. ``x`` holds one value a variable, ``(*leading, n)``; per-pair tensors have shape
``(*leading, *edge_shape)``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Graph(Protocol):
    """A layout of coupled pairs (first, second)."""

    @property
    def n(self) -> int:
        """Number of variables."""
        ...

    @property
    def edge_shape(self) -> tuple[int, ...]:
        """Shape of one number a pair."""
        ...

    def gather(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Values at the first and second variable of each pair, broadcastable to ``edge_shape``."""
        ...

    def scatter(self, first: Tensor, second: Tensor) -> Tensor:
        """Sum per-pair numbers onto the first and the second variables: ``(*leading, n)``."""
        ...

    def quadratic(self, coupling: Tensor, x: Tensor) -> Tensor:
        """``sum over pairs of coupling x_first x_second``: ``(*leading, n_states)``.

        Args:
            coupling: ``(*leading, *edge_shape)``.
            x: ``(*leading, n_states, n)``.
        """
        ...

    def field(self, coupling: Tensor, x: Tensor) -> Tensor:
        """Derivative of :meth:`quadratic` by x: ``(*leading, n_states, n)``."""
        ...

    def alternating(self) -> Tensor:
        """+1 or -1 for each pair, ``edge_shape``: in which of two ways ``from_qubo`` makes a clause of it.

        Every variable has about as many of each, so that its unit clauses largely cancel.
        """
        ...

    def blocks(self) -> Iterator[slice]:
        """Slices of variables that are not coupled to each other, in order, covering all."""
        ...

    def edges(self) -> Tensor:
        """The pairs as ``(n_pairs, 2)``, in the order of a flattened per-pair tensor."""
        ...


@dataclass(frozen=True, slots=True)
class Bipartite:
    """Every variable of a first layer with every variable of a second, as in an RBM.

    The variables are (first layer, second layer); couplings are a matrix ``(n_second, n_first)``, which is
    the shape of an RBM's weight with the visible units first.
    """

    n_first: int
    n_second: int

    @property
    def n(self) -> int:
        """Number of variables."""
        return self.n_first + self.n_second

    @property
    def edge_shape(self) -> tuple[int, ...]:
        """``(n_second, n_first)``."""
        return (self.n_second, self.n_first)

    def split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The two layers of ``x``."""
        return x[..., : self.n_first], x[..., self.n_first :]

    def gather(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The layers as a row and a column, ready to broadcast."""
        first, second = self.split(x)
        return first.unsqueeze(-2), second.unsqueeze(-1)

    def scatter(self, first: Tensor, second: Tensor) -> Tensor:
        """Sum over the columns and over the rows."""
        return torch.cat((first.sum(-2), second.sum(-1)), dim=-1)

    def quadratic(self, coupling: Tensor, x: Tensor) -> Tensor:
        """``sum_ij coupling_ij second_i first_j``."""
        first, second = self.split(x)
        return ((second @ coupling) * first).sum(-1)

    def field(self, coupling: Tensor, x: Tensor) -> Tensor:
        """Couplings times the other layer."""
        first, second = self.split(x)
        return torch.cat((second @ coupling, first @ coupling.mT), dim=-1)

    def alternating(self) -> Tensor:
        """+1 between the first halves of both layers and between their second halves."""
        second, first = (2 * torch.arange(n) >= n for n in (self.n_second, self.n_first))
        return 1.0 - 2 * (second.unsqueeze(-1) ^ first)

    def blocks(self) -> Iterator[slice]:
        """The two layers."""
        yield slice(0, self.n_first)
        yield slice(self.n_first, self.n)

    def edges(self) -> Tensor:
        """All pairs (first, n_first + second)."""
        second, first = torch.meshgrid(torch.arange(self.n_second), torch.arange(self.n_first), indexing="ij")
        return torch.stack((first.flatten(), self.n_first + second.flatten()), dim=-1)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeList:
    """Any pairs, listed: couplings are a vector with one number a pair.

    Attributes:
        n: Number of variables.
        pairs: ``(n_pairs, 2)`` int64, first < second.
    """

    n: int
    pairs: Tensor

    @property
    def edge_shape(self) -> tuple[int, ...]:
        """``(n_pairs,)``."""
        return (self.pairs.shape[0],)

    def gather(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Index both ends of every pair."""
        return x[..., self.pairs[:, 0]], x[..., self.pairs[:, 1]]

    def scatter(self, first: Tensor, second: Tensor) -> Tensor:
        """Add each end's number to its variable."""
        total = first.new_zeros(*first.shape[:-1], self.n)
        total.index_add_(-1, self.pairs[:, 0], first)
        return total.index_add_(-1, self.pairs[:, 1], second)

    def quadratic(self, coupling: Tensor, x: Tensor) -> Tensor:
        """``sum over pairs of coupling x_first x_second``."""
        first, second = self.gather(x)
        return (coupling.unsqueeze(-2) * first * second).sum(-1)

    def field(self, coupling: Tensor, x: Tensor) -> Tensor:
        """Couplings times the other end, summed."""
        first, second = self.gather(x)
        return self.scatter(coupling.unsqueeze(-2) * second, coupling.unsqueeze(-2) * first)

    def alternating(self) -> Tensor:
        """Every other pair of the list."""
        return 1.0 - 2 * (torch.arange(self.pairs.shape[0], device=self.pairs.device) % 2)

    def blocks(self) -> Iterator[slice]:
        """One variable at a time."""
        return (slice(i, i + 1) for i in range(self.n))

    def edges(self) -> Tensor:
        """The pairs."""
        return self.pairs
