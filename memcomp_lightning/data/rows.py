"""Some rows of a data set, as the visible units keep them."""

from typing import NamedTuple

from torch import Tensor

UNLABELLED = -1
"""The class of a row that has none."""


class Rows(NamedTuple):
    """Rows of data.

    Attributes:
        v: A number a site, float32, ``(*replicas, n, n_sites)``; 0 where it is missing.
        label: Class indices, int64, ``(*replicas, n)``; -1 where there is none.
        observed: Where ``v`` is known, a mask of its shape; None is everywhere.
        weight: How often each row counts, > 0, ``(*replicas, n)``; None is once.
    """

    v: Tensor
    label: Tensor
    observed: Tensor | None = None
    weight: Tensor | None = None

    def at(self, index: Tensor) -> "Rows":
        """Some of them, by their numbers."""
        return Rows(*(None if part is None else part[index] for part in self))  # type: ignore[arg-type]

    @property
    def n(self) -> int:
        """Number of rows of a replica."""
        return self.label.shape[-1]
