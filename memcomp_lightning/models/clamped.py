"""Chains of which some visible units are known, other ones in each chain."""

import torch
from torch import Generator, Tensor

from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.chains import ClassChains
from memcomp_lightning.models.observed import check_mask
from memcomp_lightning.types import Configurations


class ClampedChains(ClassChains):
    """Chains of all units of a model, which draw what is not known given what is.

    A state has all units, visible ones first, in an RBM too. Where there are several times as many chains as rows,
    as on a ladder of temperatures, the rows come again in the same order.

    Args:
        model: Of any connectivity, without replica axes.
        v: What is known, ``(n, n_visible)``; other values there are not read.
        observed: Where it is known, a mask of this shape.
    """

    def __init__(self, model: EnergyModel, v: Tensor, observed: Tensor) -> None:
        check_mask(model, v, observed)
        super().__init__(model)
        hidden = v.new_zeros(len(v), model.n_hidden)
        self._known = torch.cat((torch.where(observed, v, 0.0), hidden), dim=-1)
        self._fixed = torch.cat((observed, hidden.bool()), dim=-1)

    def held(self, x: Tensor) -> Tensor:
        """States with what is known in its place."""
        known, fixed = self._beside(x)
        return torch.where(fixed, known, x)

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw all that is not known, as at infinite temperature."""
        return self.held(super().random(n, generator=generator))

    def sweep(self, x: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
        """Draw each class given all others, but for what is known."""
        x = x.clone()
        known, fixed = self._beside(x)
        for block in self._blocks:
            drawn = block.kind.sample(beta * block.field(x), generator=generator)
            x[..., block.units] = torch.where(fixed[..., block.units], known[..., block.units], drawn)
        return x

    def read(self, x: Tensor) -> Configurations:
        """The states, the last class by its means, but for what is known."""
        found = super().read(x)
        return Configurations(*self._split(self.held(torch.cat((found.v, found.h), dim=-1))))

    def _beside(self, x: Tensor) -> tuple[Tensor, Tensor]:
        times = x.shape[-2] // len(self._known)
        return self._known.repeat(times, 1), self._fixed.repeat(times, 1)
