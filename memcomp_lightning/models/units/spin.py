"""Units in {-1, +1}."""

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.enumeration import bits
from memcomp_lightning.models.units.base import Bits, PerSite, Units, Values, require_values
from memcomp_lightning.models.units.bernoulli import Bernoulli


class Spin(Units):
    r"""Units that are -1 or +1, as in the Ising model; :math:`A(f) = \log(2 \cosh f)`.

    Couplings between spins are the J and biases the h of :math:`E = -\sum J_{ij} s_i s_j - \sum h_i s_i`.

    Args:
        n: Number of units.
    """

    def mean(self, field: Values) -> Values:
        """tanh(field)."""
        return torch.tanh(field)

    def sample(self, field: Values, *, generator: Generator) -> Values:
        """Draw -1 or +1."""
        return 2 * rng.bernoulli(torch.sigmoid(2 * field), generator=generator) - 1

    def sample_of_mean(self, mean: Values, *, generator: Generator) -> Values:
        """Draw -1 or +1; p(+1) is (1 + mean) / 2."""
        return 2 * rng.bernoulli((1 + mean) / 2, generator=generator) - 1

    def mode(self, field: Values) -> Values:
        """+1 where the field is positive, else -1."""
        return 2 * (field > 0).to(field.dtype) - 1

    def cumulant(self, field: Values) -> PerSite:
        """log(2 cosh(field)), without overflow."""
        size = field.abs()
        return size + torch.log1p(torch.exp(-2 * size))

    def negative_entropy(self, mean: Values) -> Tensor:
        """Sum of p log p over both values, with p(+1) = (1 + m) / 2."""
        up, down = (1 + mean) / 2, (1 - mean) / 2
        total: Tensor = (torch.special.xlogy(up, up) + torch.special.xlogy(down, down)).sum(-1)
        return total

    def cumulant_gain(self, field: Values, beta: float, target: float) -> Tensor:
        """As that of bits, because log(2 cosh f) = log(1 + exp(2 f)) - f."""
        linear = (target - beta) * field.sum(-1).double()
        return Bernoulli(self.n).cumulant_gain(2 * field, beta, target) - linear

    def check(self, v: Values, observed: Tensor | None = None, *, pure: bool = False, column: int = 0) -> None:
        """Values are in [-1, 1]; in between they are means."""
        remedy = "For bits in {0, 1} give 2 v - 1, or use Bernoulli units."
        if pure:
            require_values(v, v.abs() == 1, observed, column, "values in {-1, 1} for spins", remedy)
        else:
            require_values(v, (v >= -1) & (v <= 1), observed, column, "values in [-1, 1] for spins", remedy)

    def from_intensity(self, v: PerSite) -> Tensor:
        """2 v - 1: between black and white they are means."""
        return 2 * v - 1

    def to_intensity(self, x: Values) -> PerSite:
        """(x + 1) / 2."""
        return (x + 1) / 2

    def bias_of(self, total: Values, n: float | Tensor) -> Values:
        """Half of log (n_up + 1) / (n_down + 1)."""
        n_up = (n + total) / 2
        return torch.log((n_up + 1) / (n - n_up + 1)) / 2

    def states(self, numbers: Tensor, *, like: Tensor) -> Tensor:
        """Binary numbers, 0 read as -1, the first unit being the highest bit."""
        return 2 * bits(numbers, self.n, like=like) - 1

    @property
    def n_states(self) -> int:
        """2^n."""
        return 1 << self.n

    def bits(self) -> Bits:
        """S = 2 x - 1."""
        return Bits(
            torch.arange(self.n, device="cpu"),
            torch.full((self.n,), -1.0, device="cpu"),
            torch.full((self.n,), 2.0, device="cpu"),
        )

    def beside(self, other: Units) -> "Spin | None":
        """Spins all together."""
        return Spin(self.n + other.n) if type(other) is Spin else None
