"""The ground state by Gibbs sweeps of the model itself at falling temperature."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.bit_form import descend, integrated_energy, with_real_spread
from memcomp_lightning.models.units import Mixed, Units, side_by_side
from memcomp_lightning.types import Configurations, NegativePhase, NoState


@dataclass(frozen=True, kw_only=True, slots=True)
class BlockAnnealing:
    r"""Takes the state of lowest energy that chains of the model reach as the temperature falls.

    Chains start at random states and draw each class of units given the others from :math:`e^{-\beta E}`, with
    inverse temperatures in equal ratios, and then descend. No units need a form in bits, and a categorical one is
    always in one state: with many states that is quicker than a solver with a penalty a site.
    Real units have the variance :math:`1 / (\beta \gamma)` here, their measure being a part of E; that of discrete
    kinds of one's own is taken as it is. ``ground_state_energy`` has real units integrated out, as a QUBO's has.

    Attributes:
        n_chains: Starts a replica, >= 1.
        n_sweeps: Temperatures, a sweep each, >= 1.
        beta_first: First inverse temperature, > 0.
        beta_last: Last inverse temperature, >= ``beta_first``.
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = True

    n_chains: int = 32
    n_sweeps: int = 100
    beta_first: float = 0.1
    beta_last: float = 10.0

    def __post_init__(self) -> None:
        require_count("n_chains", self.n_chains)
        require_count("n_sweeps", self.n_sweeps)
        first, last = self.beta_first, self.beta_last
        require(first > 0 and math.isfinite(first), "beta_first", first, "a number > 0")
        require(last >= first and math.isfinite(last), "beta_last", last, f"a number >= beta_first = {first}")

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> NoState:
        """Nothing to remember: every call starts at random states."""
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return the lowest state, one a replica; real units stand at two points around their means."""
        x = anneal(model, self.n_chains, self.betas(), generator=generator)
        n = model.n_visible
        found = descend(model, Configurations(x[..., :n], x[..., n:]))
        energies = model.energy(found.v, found.h).double()
        lowest, at = energies.min(-1)
        best = Configurations(*(part.take_along_dim(at[..., None, None], dim=-2) for part in found[:2]))
        reached = (energies <= (lowest + 1e-6 * lowest.abs()).unsqueeze(-1)).float().mean(-1)
        # Hidden units without a form in bits (ReLU) are not integrated out: the lowest E itself was sought.
        no_bits = model.hidden.real and model.hidden.curvature is None
        energy = lowest if no_bits else integrated_energy(model, best).squeeze(-1).double()
        info = {"ground_state_energy": energy, "chains_at_best": reached}
        return NegativePhase(with_real_spread(model, best), state, info)

    def betas(self) -> list[float]:
        """Inverse temperatures of the sweeps.

        >>> BlockAnnealing(n_sweeps=3).betas()
        [0.1, 1.0, 10.0]
        """
        ratio, steps = self.beta_last / self.beta_first, max(self.n_sweeps - 1, 1)
        return [self.beta_first * ratio ** (k / steps) for k in range(self.n_sweeps)]


@torch.no_grad()
def anneal(model: EnergyModel, n: int, betas: list[float], *, generator: Generator) -> Tensor:
    """States after a sweep of exp(-beta E) at each inverse temperature, ``(*replicas, n, n_units)``."""
    blocks, layer = model.blocks(), side_by_side(model.visible, model.hidden)
    x = layer.sample(model.b.new_zeros(*model.replicas, n, model.n_units), generator=generator)
    for beta in betas:
        for block in blocks:
            x[..., block.units] = _drawn(block.kind, block.field(x), beta, generator)
    return x


def _drawn(kind: Units, field: Tensor, beta: float, generator: Generator) -> Tensor:
    """Draw units from exp(beta (field . x + log mu(x))), where the measure of real ones is exp of a square."""
    if isinstance(kind, Mixed):
        parts = zip(kind.kinds, field.split([part.n for part in kind.kinds], dim=-1), strict=True)
        return torch.cat([_drawn(part, of_part, beta, generator) for part, of_part in parts], dim=-1)
    if not kind.real:
        return kind.sample(beta * field, generator=generator)
    root = math.sqrt(beta)
    return kind.sample(root * field, generator=generator) / root
