"""Values of visible units in the words of their data, as pictures show them."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from memcomp_lightning.data.schema import Columns, Schema
from memcomp_lightning.data.written import SEQUENCE
from memcomp_lightning.models.units import Units


@dataclass(frozen=True, eq=False)
class Shown:
    """Rows of data, or of samples.

    Attributes:
        units: The visible units, without replica axes that matter here.
        v: Their values, ``(n, n_visible)``.
        observed: Where they are known, a mask of the same shape; None is everywhere.
        weight: How often each row counts, ``(n,)``; None is once.
        schema: What the units stand for; None where that is not known.
    """

    units: Units
    v: Tensor
    observed: Tensor | None = None
    weight: Tensor | None = None
    schema: Schema | None = None

    @property
    def complete(self) -> "Shown":
        """The rows without a missing value."""
        if self.observed is None:
            return self
        whole = self.observed.all(-1)
        weight = None if self.weight is None else self.weight[whole]
        return replace(self, v=self.v[whole], observed=None, weight=weight)

    def drawn(self, generator: Generator) -> "Shown":
        """The rows with values in place of means in between, as grey values are."""
        return replace(self, v=self.units.values_of(self.v, generator=generator))

    @property
    def weights(self) -> NDArray[np.float64] | None:
        """The weights as an array."""
        return None if self.weight is None else self.weight.double().cpu().numpy()

    @property
    def entries(self) -> NDArray[np.float64]:
        """The values, NaN where they are missing, ``(n, n_visible)``."""
        v = self.v.double()
        known = v if self.observed is None else torch.where(self.observed, v, torch.nan)
        found: NDArray[np.float64] = known.detach().cpu().numpy()
        return found

    @property
    def entry_names(self) -> list[str]:
        """Names of the visible units; numbers where the schema has other ones."""
        names = [] if self.schema is None else self.schema.entry_names
        return names if len(names) == self.units.n else [f"unit {k}" for k in range(self.units.n)]

    @property
    def columns(self) -> Columns:
        """The rows in the user's columns and words; sequences have a column of letters for each site.

        Pixels, and units of which nothing is known, keep the numbers of the units; states are texts.
        """
        numbers, schema = self._numbers(), self.schema
        if schema is None or schema.units() is None:
            n, of_pixels = self.units.n_sites, [] if schema is None else schema.site_names
            names = [f"unit {k}" for k in range(n)] if schema is None else [f"pixel {name}" for name in of_pixels]
            sizes = torch.bincount(self.units.site_of(), minlength=n).tolist()
            cells = numbers.cpu().numpy()
            return {
                name: cells[:, site] if size == 1 else _states(cells[:, site], size)
                for site, (name, size) in enumerate(zip(names, sizes, strict=True))
            }
        found = schema.decode(numbers)
        if SEQUENCE not in found or SEQUENCE in schema.site_names:
            return found
        letters = np.array([list(row) for row in found[SEQUENCE]], dtype=object)
        letters[numbers.isnan().cpu().numpy()] = None
        return {f"site {name}": letters[:, site] for site, name in enumerate(schema.site_names)}

    def _numbers(self) -> Tensor:
        """One number a site, NaN where it is missing."""
        numbers = self.units.decode(self.v).to(self.v.dtype)
        if self.observed is None:
            return numbers
        known = self.units.site_sums(self.observed.to(self.v.dtype)) > 0
        return torch.where(known, numbers, torch.nan)


def _states(numbers: NDArray[np.floating], size: int) -> NDArray[np.object_]:
    """Numbers of states as texts of one length, which keep their order; None where one is missing."""
    width = len(str(size - 1))
    return np.array([None if k != k else f"{int(k):0{width}}" for k in numbers.tolist()], dtype=object)
