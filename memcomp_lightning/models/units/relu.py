"""Hidden units that are positive: rectified normal conditionals."""

import math
from typing import ClassVar

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.models.units.base import PerSite, Units, Values, require_values

_FAR = 40.0
"""In float64 the mean is a sum of powers of 1 / f below minus this field."""

_NEWTON_STEPS = 30
"""They come from above, where the steps are safe, and are many more than double precision needs."""

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
        far = _is_far(field)
        below = torch.where(far, field, -_FAR)
        inverse = below.reciprocal().square()
        tail = 1 - inverse * (2 - inverse * (10 - inverse * (74 - inverse * 706)))
        near = torch.where(far, 0.0, field)
        return torch.where(far, -tail / below, near + _hazard(near))

    def points(self, field: Values) -> list[Values]:
        """Mean plus and mean less a standard deviation, which is at most the mean."""
        far, mean = _is_far(field), self.mean(field)
        below = torch.where(far, field, -_FAR)
        inverse = below.reciprocal().square()
        tail = inverse * (1 - inverse * (6 - inverse * (50 - inverse * (518 - inverse * 6354))))
        near = torch.where(far, 0.0, field)
        deviation = torch.where(far, tail, 1 - _hazard(near) * torch.where(far, 1.0, mean)).clamp(min=0.0).sqrt()
        return [mean + deviation, (mean - deviation).clamp(min=0.0)]

    def sample(self, field: Values, *, generator: Generator) -> Values:
        """Draw by inversion, in float64."""
        f = field.double()
        u = 1 - rng.uniform(f.shape, generator=generator, like=f)  # in (0, 1]
        near = f.clamp(min=_TAIL)
        # The part of the distribution above zero, seen from its upper end: never 1 - p for a small p.
        # (torch.special.ndtr is zero below -8.3.)
        found = near - torch.special.ndtri(u * 0.5 * torch.special.erfc(-near / math.sqrt(2)))
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

    def site_energies(self, x: Values) -> PerSite:
        """Half of x^2."""
        return 0.5 * x.square()

    def check(self, v: Values, observed: Tensor | None = None, *, pure: bool = False, column: int = 0) -> None:
        """Values are finite and >= 0."""
        require_values(v, (v >= 0) & v.isfinite(), observed, column, "finite values >= 0 for ReLU units")

    def bias_of(self, total: Values, n: float | Tensor) -> Values:
        """By Newton's method: the mean is a convex function of the field. A mean of zero counts as a hundredth."""
        mean = (total / n).double().clamp(min=0.01)
        field = mean - 1 / mean
        for _ in range(_NEWTON_STEPS):
            value = self.mean(field)
            field = field - (value - mean) / (1 - (value - field) * value).clamp(min=1e-6)
        return field.to(total.dtype)


def _is_far(field: Tensor) -> Tensor:
    """Where sums for fields far below zero have more right digits than differences."""
    return field < (-_FAR if field.dtype == torch.float64 else -8.0)


def _hazard(field: Tensor) -> Tensor:
    """phi(f) / Phi(f), the normal density over its distribution; zero where it is below rounding."""
    ratio = math.sqrt(2 / math.pi) / torch.special.erfcx(-field.clamp(max=8.5) / math.sqrt(2))
    return torch.where(field > 8.5, 0.0, ratio)
