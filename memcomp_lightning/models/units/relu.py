"""Hidden units that are positive: rectified normal conditionals."""

import math
from typing import ClassVar

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.models.units.base import PerSite, Units, Values, require_values

_TAIL = -30.0
"""Below this field a truncated normal is drawn by its Rayleigh tail, which is then exact to a thousandth."""


class ReLU(Units):
    r"""Units x >= 0 with :math:`\mu(x) = e^{-x^2 / 2}`: normal distributions cut off at zero.

    .. math:: A(f) = \frac{f^2}{2} + \log(\sqrt{2 \pi} \Phi(f)), \quad E[x | f] = f + \phi(f) / \Phi(f)

    with the normal density :math:`\phi` and distribution :math:`\Phi`. (Tubiana, Cocco & Monasson 2019.) As hidden
    units their precision can be one, because their weights set the scale. The mean is a smooth version of
    max(0, f). They have no list of states and no form in bits.

    Args:
        n: Number of units.
    """

    linear: ClassVar[bool] = False
    real: ClassVar[bool] = True

    def mean(self, field: Values) -> Values:
        """F + phi(f) / Phi(f), without cancellation where f is far below zero."""
        far = field < -8.0
        inverse = torch.where(far, field, -8.0).reciprocal().square()
        tail = 1 - inverse * (2 - inverse * (10 - inverse * (74 - inverse * 706)))
        near = torch.where(far, 0.0, field)
        ratio = math.sqrt(2 / math.pi) / torch.special.erfcx(-near.clamp(max=8.0) / math.sqrt(2))
        ratio = torch.where(near > 8.0, 0.0, ratio)
        return torch.where(far, -tail / torch.where(far, field, -8.0), near + ratio)

    def sample(self, field: Values, *, generator: Generator) -> Values:
        """Draw by inversion, in float64."""
        f = field.double()
        u = 1 - rng.uniform(f.shape, generator=generator, like=f)  # in (0, 1]
        near = f.clamp(min=_TAIL)
        # The part of the distribution above zero, seen from its upper end: never 1 - p for a small p.
        found = near - torch.special.ndtri(u * torch.special.ndtr(near))
        tail = (f.square() - 2 * u.log()).sqrt() + f
        return torch.where(f < _TAIL, tail, found).clamp(min=0.0).to(field.dtype)

    def mode(self, field: Values) -> Values:
        """max(0, field)."""
        return field.clamp(min=0.0)

    def cumulant(self, field: Values) -> PerSite:
        """f^2 / 2 + log(sqrt(2 pi) Phi(f)), by a scaled function where f is below zero."""
        below = torch.special.erfcx(-field.clamp(max=0.0) / math.sqrt(2)).log() + 0.5 * math.log(math.pi / 2)
        above = field.clamp(min=0.0)
        above = above.square() / 2 + torch.special.log_ndtr(above) + 0.5 * math.log(2 * math.pi)
        return torch.where(field > 0, above, below)

    def energy(self, x: Values) -> Tensor:
        """Half of x^2, summed."""
        return 0.5 * x.square().sum(-1)

    def check(self, v: Values, observed: Tensor | None = None, *, pure: bool = False, column: int = 0) -> None:
        """Values are finite and >= 0."""
        require_values(v, (v >= 0) & v.isfinite(), observed, column, "finite values >= 0 for ReLU units")

    def bias_of(self, total: Values, n: float | Tensor) -> Values:
        """The mean, which is the field where it is above one."""
        return total / n
