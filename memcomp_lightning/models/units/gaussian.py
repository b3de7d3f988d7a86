"""Real units, normally distributed given their fields."""

import math
from numbers import Real
from typing import ClassVar

import torch
from torch import Generator, Tensor, nn

from memcomp_lightning.errors import require
from memcomp_lightning.models.units.base import Bits, PerSite, Units, Values, require_values

SMALLEST_SHARE = 0.05
"""A learned variance stays below 1 / 0.05 = 20 times that of the data, or of the first value."""

LARGEST_SHARE = 1e4
"""It stays above 1e-4 times that: a single row must not get all density."""


class Gaussian(Units):
    r"""Real units with normal conditionals, in natural parameters: field f and precision :math:`\gamma`.

    .. math:: \mu(x) = e^{-\gamma x^2 / 2}, \quad x | f \sim N(f / \gamma, 1 / \gamma), \quad
              A(f) = \frac{f^2}{2 \gamma} + \frac{1}{2} \log \frac{2 \pi}{\gamma}

    The energy is linear in both, as in every other parameter of a model. Give columns of about unit variance: one
    learning rate then fits all of them.

    Args:
        n: Number of units.
        variance: :math:`1 / \gamma` to begin with, a number or ``(n,)``, > 0 and finite.
        learned: Whether training changes it.

    Attributes:
        precision: :math:`\gamma`, ``(*replicas, n)``.

    Raises:
        SettingError: A variance that is not > 0 or not finite.
    """

    linear: ClassVar[bool] = False
    real: ClassVar[bool] = True

    def __init__(self, n: int, *, variance: float | Tensor = 1.0, learned: bool = True) -> None:
        super().__init__(n)
        number = isinstance(variance, Real | Tensor) and not isinstance(variance, bool)
        require(number, "variance", variance, f"a number > 0, or a tensor of {n} numbers")
        given = torch.as_tensor(variance, dtype=torch.float32, device="cpu")
        require(given.shape in ((), (n,)), "shape of variance", tuple(given.shape), f"() or ({n},)")
        wrong = ~_usable(given).expand(n)
        if bool(wrong.any()):
            column = int(wrong.nonzero()[0])
            _refuse_variance(float(given.expand(n)[column]), column)
        self.learned = learned
        precision = (1 / given).expand(n).clone()
        self.precision: Tensor
        if learned:
            self.precision = nn.Parameter(precision)
        else:
            self.register_buffer("precision", precision)
        self.first_precision: Tensor
        self.register_buffer("first_precision", precision.clone())

    def mean(self, field: Values) -> Values:
        """Field / precision."""
        return field / self._beside(self.precision, field)

    @torch.no_grad()
    def sample(self, field: Values, *, generator: Generator) -> Values:
        """Draw from N(field / precision, 1 / precision)."""
        noise = torch.empty(field.shape, dtype=field.dtype, device=generator.device)
        noise = noise.normal_(generator=generator).to(field.device)
        # One pass over memory for each of two operations.
        deviation = noise.mul_(self._beside(self.precision.rsqrt(), field))
        return torch.addcdiv(deviation, field, self._beside(self.precision, field))

    def mode(self, field: Values) -> Values:
        """The mean."""
        return self.mean(field)

    def cumulant(self, field: Values) -> PerSite:
        """f^2 / (2 precision) + log(2 pi / precision) / 2."""
        precision = self._beside(self.precision.to(field.dtype), field)
        return field.square() / (2 * precision) + 0.5 * torch.log(2 * math.pi / precision)

    def points(self, field: Values) -> list[Values]:
        """Mean plus and mean less a standard deviation: their first and second moments are the exact ones."""
        mean, deviation = self.mean(field), self._beside(self.precision.rsqrt(), field)
        return [mean + deviation, mean - deviation]

    @property
    def curvature(self) -> Tensor:
        """The precision."""
        return self.precision

    def site_energies(self, x: Values) -> PerSite:
        """Half of precision x^2."""
        return 0.5 * (x.square() * self._beside(self.precision, x))

    def total_energy(self, x: Values, weight: Tensor) -> Tensor:
        """By the sums of squares, so that its backward pass is one of a vector."""
        with torch.no_grad():
            squares = 0.5 * (weight.unsqueeze(-2) @ x.square()).squeeze(-2)
        total: Tensor = torch.linalg.vecdot(self.precision, squares)
        return total

    @staticmethod
    def _beside(own: Tensor, x: Tensor) -> Tensor:
        """A parameter ``(*replicas, n)`` with an axis for each of x between the replicas and the units."""
        return own.reshape(*own.shape[:-1], *[1] * (x.ndim - own.ndim), own.shape[-1])

    @torch.no_grad()
    def project(self) -> None:
        """Keep a learned precision positive, and between shares of the first one."""
        if self.learned:
            first = self.first_precision
            self.precision.clamp_(SMALLEST_SHARE * first, LARGEST_SHARE * first)

    def check(self, v: Values, observed: Tensor | None = None, *, pure: bool = False, column: int = 0) -> None:
        """Values are finite."""
        remedy = "Mark missing values by a mask."
        require_values(v, v.isfinite(), observed, column, "finite values for Gaussian units", remedy)

    def from_intensity(self, v: PerSite) -> Tensor:
        """Grey values themselves."""
        return v

    def to_intensity(self, x: Values) -> PerSite:
        """The values themselves, which may be outside of [0, 1]."""
        return x

    def bias_of(self, total: Values, n: float | Tensor) -> Tensor:
        """Mean times precision."""
        return total / n * self.precision

    @torch.no_grad()
    def start(self, mean: Values, variance: Values, *, column: int = 0) -> None:
        """Take the precisions of the data, if they are learned.

        Raises:
            SettingError: A column that is constant.
        """
        if not self.learned:
            return
        usable = _usable(variance)
        if not bool(usable.all()):
            place = (~usable).nonzero()[0].tolist()
            _refuse_variance(float(variance[tuple(place)]), column + place[-1])
        self.precision.copy_((1 / variance).expand_as(self.precision))
        self.first_precision.copy_(self.precision)

    def bits(self) -> Bits:
        """None: the units are integrated out."""
        return Bits(torch.arange(0, device="cpu"), torch.zeros(0, device="cpu"), torch.zeros(0, device="cpu"))


def _usable(variance: Tensor) -> Tensor:
    """Whether numbers are variances: of the smallest ones the precision would not be finite."""
    return (variance > 0) & variance.isfinite() & variance.reciprocal().isfinite()


def _refuse_variance(value: float, column: int) -> None:
    allowed = "a number > 0 for Gaussian units, finite and with a finite inverse"
    require(False, f"variance of column {column}", value, allowed, "Leave out columns that are constant.")
