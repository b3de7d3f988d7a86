"""Units in {0, 1}."""

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.enumeration import bits
from memcomp_lightning.models.units.base import Bits, PerSite, Units, Values, require_values


class Bernoulli(Units):
    r"""Units that are 0 or 1; :math:`A(f) = \log(1 + e^f)`.

    Args:
        n: Number of units.
    """

    def mean(self, field: Values) -> Values:
        """p(x = 1 | field)."""
        return torch.sigmoid(field)

    def sample(self, field: Values, *, generator: Generator) -> Values:
        """Draw 0 or 1."""
        p = torch.sigmoid(field)
        return rng.uniform(p.shape, generator=generator, like=p).lt_(p)

    def sample_of_mean(self, mean: Values, *, generator: Generator) -> Values:
        """Draw 0 or 1; the mean is the probability of 1."""
        return rng.uniform(mean.shape, generator=generator, like=mean).lt_(mean)

    def mode(self, field: Values) -> Values:
        """1 where the field is positive."""
        return (field > 0).to(field.dtype)

    def cumulant(self, field: Values) -> PerSite:
        """log(1 + exp(field)), to all digits in float64."""
        return F.softplus(field, threshold=40.0 if field.dtype == torch.float64 else 20.0)

    def negative_entropy(self, mean: Values) -> Tensor:
        """Sum of m log m + (1 - m) log(1 - m)."""
        total: Tensor = (torch.special.xlogy(mean, mean) + torch.special.xlogy(1 - mean, 1 - mean)).sum(-1)
        return total

    def cumulant_gain(self, field: Values, beta: float, target: float) -> Tensor:
        """The same with no difference of large numbers.

        From low to high a unit gains (high - low) max(f, 0) + log1p(sigmoid(-low |f|) expm1(-(high - low) |f|)),
        and the argument of log1p is in [-1/2, 0].
        """
        low, high = min(beta, target), max(beta, target)
        size = field.abs()
        linear = (high - low) / 2 * (field.sum(-1).double() + size.sum(-1).double())
        fall = size.mul(low - high).expm1_().mul_(size.mul_(-low).sigmoid_()).log1p_().sum(-1).double()
        return (linear + fall) * (1 if target > beta else -1)

    def check(self, v: Values, observed: Tensor | None = None, *, pure: bool = False, column: int = 0) -> None:
        """Values are in [0, 1]; between 0 and 1 they are probabilities."""
        if pure:
            remedy = "Grey values have no likelihood under a Bernoulli RBM: binarise the images, say v > 0.5."
            require_values(v, (v == 0) | (v == 1), observed, column, "values in {0, 1}", remedy)
        else:
            remedy = "Scale the column, or give it real or categorical units."
            require_values(
                v, (v >= 0) & (v <= 1), observed, column, "values in [0, 1] for Bernoulli units", remedy
            )

    def from_intensity(self, v: PerSite) -> Tensor:
        """Grey values themselves, as probabilities of a 1."""
        return v

    def to_intensity(self, x: Values) -> PerSite:
        """The values themselves."""
        return x

    def bias_of(self, total: Values, n: float | Tensor) -> Values:
        """Log (n_on + 1) / (n_off + 1)."""
        return torch.log((total + 1) / (n - total + 1))

    def states(self, numbers: Tensor, *, like: Tensor) -> Tensor:
        """Binary numbers, the first unit being the highest bit."""
        return bits(numbers, self.n, like=like)

    @property
    def n_states(self) -> int:
        """2^n."""
        return 1 << self.n

    def bits(self) -> Bits:
        """A bit a unit."""
        return Bits(
            torch.arange(self.n, device="cpu"), torch.zeros(self.n, device="cpu"), torch.ones(self.n, device="cpu")
        )

    def beside(self, other: Units) -> "Bernoulli | None":
        """Units in {0, 1} all together."""
        return Bernoulli(self.n + other.n) if type(other) is Bernoulli else None
