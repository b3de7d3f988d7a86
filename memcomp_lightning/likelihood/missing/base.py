"""What is known of missing values, and what must be offered to find it."""

from typing import NamedTuple, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.units import Units

SHARES = (0.05, 0.95)
"""Of the distribution of a real value, below both ends of its interval: 90 % lie within."""


class Conditional(NamedTuple):
    """p(missing values | observed ones) of some rows; what stands at entries that are observed means nothing.

    Attributes:
        mean: Expectation of each visible entry, ``(n, n_visible)``: of a bit and of a state its probability.
        real: Standard deviation, 5 % and 95 % quantile of each real unit, ``(3, n, n_real)``.
        draws: Completed rows, drawn independently, missing values of a row jointly, ``(m, n, n_visible)``.
        r_hat: Split R-hat of the chains of each row, the largest of its missing entries, ``(n,)``; NaN of sums.
    """

    mean: Tensor
    real: Tensor
    draws: Tensor
    r_hat: Tensor


class ConditionalFinder(Protocol):
    """A way to find :class:`Conditional`."""

    def numbers_a_row(self, model: EnergyModel, m: int) -> int:
        """About how many numbers are held for each row, where ``m`` draws are asked for."""

    def find(
        self,
        model: EnergyModel,
        v: Float[Tensor, "n n_visible"],
        observed: Bool[Tensor, "n n_visible"],
        *,
        m: int = 0,
        generator: Generator,
    ) -> Conditional:
        """What is known of the missing values, and ``m`` draws.

        Args:
            model: Without replica axes.
            v: Values of the visible units; where they are missing they are not read.
            observed: Where they are known.
            m: Number of draws, >= 0.
            generator: Of the draws.
        """


def real_entries(units: Units) -> Int[Tensor, " n_real"]:
    """Numbers of the real entries, each normally distributed given the other layer.

    Raises:
        SettingError: Units that are real in another way.
    """
    known = not units.real or units.curvature is not None
    require(known, "visible units", type(units).__name__, "discrete units, or real ones with a precision")
    return units.real_entries().nonzero().flatten()


def width_of(units: Units, entry: int) -> float:
    """Standard deviation of a real entry given the other layer."""
    curvature = units.curvature
    assert curvature is not None
    return float(curvature[entry] ** -0.5)


def drawn(weight: Float[Tensor, "n k"], m: int, *, generator: Generator) -> Int[Tensor, "m n"]:
    """Draw m numbers for each row of weights that add up to one, by inversion."""
    below = weight.cumsum(-1)
    u = rng.uniform((len(weight), m), generator=generator, like=below) * below[:, -1:]
    # right=True finds the first sum above u: what has no weight is never drawn.
    return torch.searchsorted(below, u, right=True).clamp(max=weight.shape[-1] - 1).T
