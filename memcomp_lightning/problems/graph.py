"""Which pairs of variables are coupled, and the layout of their couplings.

A coupling is one number a pair. The layouts here let the same equations run on a matrix (RBM) or on a list
of pairs. ``x`` holds one value a variable, ``(*leading, n)``; per-pair arrays have shape
``(*leading, *edge_shape)``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from memcomp_lightning.arrays import AnyArray, Array, add_up, alike, as_array, namespace


class Graph(Protocol):
    """A layout of coupled pairs (first, second)."""

    @property
    def n(self) -> int:
        """Number of variables."""

    @property
    def edge_shape(self) -> tuple[int, ...]:
        """Shape of one number a pair."""

    def gather(self, x: Array) -> tuple[Array, Array]:
        """Values at the first and second variable of each pair, broadcastable to ``edge_shape``."""

    def scatter(self, first: Array, second: Array) -> Array:
        """Sum per-pair numbers onto the first and the second variables: ``(*leading, n)``."""

    def quadratic(self, coupling: Array, x: Array) -> Array:
        """``sum over pairs of coupling x_first x_second``, ``(*leading, n_states)``.

        States ``x`` are ``(*leading, n_states, n)``.
        """

    def field(self, coupling: Array, x: Array) -> Array:
        """Derivative of :meth:`quadratic` by x: ``(*leading, n_states, n)``."""

    def alternating(self) -> Array:
        """In which of two ways ``from_qubo`` makes a clause of each pair: +1 or -1, ``edge_shape``, in numpy.

        Every variable has about as many of each, so that its unit clauses largely cancel.
        """

    def blocks(self) -> Iterator[slice]:
        """Slices of variables that are not coupled to each other, in order, covering all."""

    def alike(self, like: AnyArray) -> "Graph":
        """The same pairs in the library and on the device of ``like``."""

    def edges(self) -> Array:
        """The pairs as ``(n_pairs, 2)``, in the order of a flattened per-pair array."""


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

    def split(self, x: Array) -> tuple[Array, Array]:
        """The two layers of ``x``."""
        return x[..., : self.n_first], x[..., self.n_first :]

    def gather(self, x: Array) -> tuple[Array, Array]:
        """The layers as a row and a column, ready to broadcast."""
        first, second = self.split(x)
        return first[..., None, :], second[..., None]

    def scatter(self, first: Array, second: Array) -> Array:
        """Sum over the columns and over the rows."""
        return namespace(first).concat((first.sum(-2), second.sum(-1)), axis=-1)

    def quadratic(self, coupling: Array, x: Array) -> Array:
        """``sum_ij coupling_ij second_i first_j``."""
        first, second = self.split(x)
        return ((second @ coupling) * first).sum(-1)

    def field(self, coupling: Array, x: Array) -> Array:
        """Couplings times the other layer."""
        first, second = self.split(x)
        return namespace(x).concat((second @ coupling, first @ coupling.mT), axis=-1)

    def alternating(self) -> Array:
        """+1 between the first halves of both layers and between their second halves."""
        second, first = (2 * np.arange(n) >= n for n in (self.n_second, self.n_first))
        return as_array(1.0 - 2 * (second[:, None] ^ first))

    def blocks(self) -> Iterator[slice]:
        """The two layers."""
        yield slice(0, self.n_first)
        yield slice(self.n_first, self.n)

    def alike(self, like: AnyArray) -> "Bipartite":
        """Itself: it holds no arrays."""
        return self

    def edges(self) -> Array:
        """All pairs (first, n_first + second)."""
        second, first = np.divmod(np.arange(self.n_second * self.n_first), self.n_first)
        return as_array(np.stack((first, self.n_first + second), axis=-1))


@dataclass(frozen=True, slots=True, eq=False)
class EdgeList:
    """Any pairs, listed: couplings are a vector with one number a pair.

    Attributes:
        n: Number of variables.
        pairs: ``(n_pairs, 2)`` int64, first < second.
    """

    n: int
    pairs: Array

    @property
    def edge_shape(self) -> tuple[int, ...]:
        """``(n_pairs,)``."""
        return (self.pairs.shape[0],)

    def gather(self, x: Array) -> tuple[Array, Array]:
        """Index both ends of every pair."""
        return x[..., self.pairs[:, 0]], x[..., self.pairs[:, 1]]

    def scatter(self, first: Array, second: Array) -> Array:
        """Add each end's number to its variable."""
        both = namespace(first).concat((first, second), axis=-1)
        return add_up(both, self.pairs.mT.reshape(-1), self.n)

    def quadratic(self, coupling: Array, x: Array) -> Array:
        """``sum over pairs of coupling x_first x_second``."""
        first, second = self.gather(x)
        return (coupling[..., None, :] * first * second).sum(-1)

    def field(self, coupling: Array, x: Array) -> Array:
        """Couplings times the other end, summed."""
        first, second = self.gather(x)
        return self.scatter(coupling[..., None, :] * second, coupling[..., None, :] * first)

    def alternating(self) -> Array:
        """Every other pair of the list."""
        return as_array(1.0 - 2 * (np.arange(self.pairs.shape[0]) % 2))

    def blocks(self) -> Iterator[slice]:
        """One variable at a time."""
        return (slice(i, i + 1) for i in range(self.n))

    def alike(self, like: AnyArray) -> "EdgeList":
        """The same pairs in the library and on the device of ``like``."""
        pairs = alike(self.pairs, like)
        return self if pairs is self.pairs else EdgeList(self.n, pairs)

    def edges(self) -> Array:
        """The pairs."""
        return self.pairs
