"""Log Z of a trained model: enumerated where that is quick, estimated where it is not."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError, UserError, require_count
from memcomp_lightning.likelihood import Ais, AisEstimate, ReverseAis, annealing_products, log_partition_function
from memcomp_lightning.likelihood.bits import in_bits
from memcomp_lightning.models import EnergyModel

MOST_BITS, MOST_OTHERS = 25, 20
"""Units of the smaller layer that are enumerated: of bits and spins a second, of other kinds a few."""

LEAST_EFFECTIVE = 1 / 3
"""Share of the chains of AIS that must be effective; below, the standard error is too small."""

FACTOR = 4
"""How many times more steps AIS takes where too few chains are effective."""

MOST_PRODUCTS = 3 * 10**11
"""Of one annealing of a machine of more than two classes: about half a minute."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Annealing:
    """Settings of AIS.

    Attributes:
        n_chains: >= 2.
        n_betas: Steps to begin with, >= 1.
        most_betas: Steps at most: they grow four times until a third of the chains is effective.
    """

    n_chains: int = 100
    n_betas: int = 1000
    most_betas: int = 16_000

    def __post_init__(self) -> None:
        require_count("n_chains", self.n_chains, 2)
        require_count("n_betas", self.n_betas)
        require_count("most_betas", self.most_betas, self.n_betas)


class LogZ(NamedTuple):
    """Log Z and how it was found.

    Attributes:
        value: In nats.
        error: Standard error, 0 where it is exact.
        ais: The estimate; None where the states were enumerated.
        reverse: AIS the other way round, from chains of the model; None where the states were enumerated.
        n_betas: Steps that AIS took; 0 where the states were enumerated.
    """

    value: float
    error: float
    ais: AisEstimate | None = None
    reverse: AisEstimate | None = None
    n_betas: int = 0

    @property
    def trusted(self) -> bool:
        """Whether enough chains of AIS were effective, and both ways agree within four standard errors."""
        if self.ais is None:
            return True
        effective = float(self.ais.effective_sample_size) >= LEAST_EFFECTIVE * self.ais.log_weights.shape[-1]
        if self.reverse is None:
            return effective
        apart = abs(float(self.reverse.log_z) - self.value)
        return effective and apart <= 4 * (float(self.reverse.standard_error) ** 2 + self.error**2) ** 0.5

    def __str__(self) -> str:
        if self.ais is None:
            return f"log Z = {self.value:.4f}, exact"
        size, n = float(self.ais.effective_sample_size), self.ais.log_weights.shape[-1]
        text = (
            f"log Z = {self.value:.3f} ± {self.error:.2g} by AIS ({self.n_betas:,} steps, "
            f"{size:.0f} of {n} chains effective"
        )
        if self.reverse is not None:
            text += (
                f"; from the other side {float(self.reverse.log_z):.3f} ± {float(self.reverse.standard_error):.2g}"
            )
        return f"{text})"


@torch.no_grad()
def log_z_of(model: EnergyModel, *, annealing: Annealing | None = None, seed: int = 0) -> LogZ:
    """Find log Z of a model without replica axes.

    AIS begins at independent units with the means of the model's own chains, so that it does not hang on the rows
    that are scored. Those chains are also where reverse AIS begins, a check that both find the same.

    Raises:
        UserError: A machine of more than two classes of units that is too large to enumerate and to anneal.
    """
    two_layers = model.two_layers()
    binary = two_layers is not None and in_bits(two_layers.rbm) is not None
    most = MOST_BITS if binary else MOST_OTHERS
    if _few(model, most):
        return LogZ(float(log_partition_function(model, max_units=most)), 0.0)
    settings = annealing or Annealing()
    if not _quick(model, settings.n_chains, settings.n_betas):
        raise UserError(
            f"log Z of a {type(model).__name__} of {len(model.classes)} classes of units, more than {most} of "
            "them outside the largest class, would take minutes to anneal: memcomp_lightning.likelihood.Ais can"
        )
    x = _samples(model, settings.n_chains, seed)
    v = x[..., : model.n_visible]
    base, n_betas = model.visible.bias_of(v.sum(-2), len(v)), settings.n_betas
    while True:
        ais = Ais(n_chains=settings.n_chains, n_betas=n_betas)
        found = ais.estimate(model, generator=rng.stream(seed, "ais"), base=base)
        enough = float(found.effective_sample_size) >= LEAST_EFFECTIVE * settings.n_chains
        more = n_betas * FACTOR
        if enough or more > settings.most_betas or not _quick(model, settings.n_chains, more):
            break
        n_betas = more
    back = ReverseAis(n_betas=n_betas)
    reverse = back.estimate(model, x, generator=rng.stream(seed, "reverse ais"), base=base)
    return LogZ(float(found.log_z), float(found.standard_error), found, reverse, n_betas)


def _few(model: EnergyModel, most: int) -> bool:
    try:
        return model.n_enumerated <= most
    except SettingError:  # hidden units that have no list of states
        return False


def _quick(model: EnergyModel, n_chains: int, n_betas: int) -> bool:
    """Whether a machine may be annealed in so many steps; those of two classes always."""
    return len(model.classes) == 2 or annealing_products(model, n_chains, n_betas) <= MOST_PRODUCTS


def _samples(model: EnergyModel, n: int, seed: int, n_sweeps: int = 1000) -> Tensor:
    """States of chains that began at random."""
    chains, generator = model.chains(), rng.stream(seed, "chains")
    x = chains.random(n, generator=generator)
    for _ in range(n_sweeps):
        x = chains.sweep(x, generator=generator)
    return x
