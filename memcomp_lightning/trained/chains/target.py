"""What rows are drawn from: a model, given what is known of each row."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from memcomp_lightning.models import EnergyModel
from memcomp_lightning.models.base import Chains
from memcomp_lightning.models.clamped import ClampedChains


@dataclass(frozen=True, eq=False)
class Target:
    """A model, and rows of which some values are known.

    Attributes:
        model: Without replica axes.
        v: Values of the visible units, ``(n_rows, n_visible)``; None is one row of which nothing is known.
        observed: Where they are known, a mask of this shape.
    """

    model: EnergyModel
    v: Tensor | None = None
    observed: Tensor | None = None

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return 1 if self.v is None else len(self.v)

    def at(self, rows: Tensor) -> "Target":
        """Some of the rows, by their numbers."""
        if self.v is None or self.observed is None:
            return self
        return replace(self, v=self.v[rows], observed=self.observed[rows])

    def some(self, n: int) -> "Target":
        """So many rows at most, spread over all of them."""
        return self.at(torch.linspace(0, self.n_rows - 1, min(n, self.n_rows), device="cpu").long())

    def chains(self, n_of_row: int) -> Chains:
        """Chains, so many of each row side by side."""
        if self.v is None or self.observed is None:
            return self.model.chains()
        wide = (part.repeat_interleave(n_of_row, dim=0) for part in (self.v, self.observed))
        return ClampedChains(self.model, *wide)

    def parts(self, n: int) -> list["Target"]:
        """All rows, n at a time."""
        return [self.at(rows) for rows in torch.arange(self.n_rows, device="cpu").split(n)]
