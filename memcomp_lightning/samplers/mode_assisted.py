"""Mode-assisted training: now and then the ground state takes the place of another sampler's negative phase."""

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.bit_form import at_real_means
from memcomp_lightning.objective import shares
from memcomp_lightning.samplers.base import NegativePhaseSampler, require_sampler
from memcomp_lightning.types import Configurations, NegativePhase


@dataclass(frozen=True, kw_only=True, slots=True)
class ModeSchedule:
    r"""How often the mode is taken: in update t of N with probability ``p_max \sigma(steepness t / N - delay)``.

    Manukian, Pei, Bearden and Di Ventra 2020 (Commun. Phys. 3:105), with the values of its public codes: next to
    none in the first quarter, half of ``p_max`` at 30 % of the training, all of it in the second half.

    Attributes:
        n_updates: N, updates of the training, >= 1; later ones keep the last probability.
        p_max: Highest probability, in [0, 1].
        steepness: How fast the probability rises.
        delay: How late it rises: it is half of ``p_max`` at t / N = delay / steepness.
    """

    n_updates: int
    p_max: float = 0.1
    steepness: float = 20.0
    delay: float = 6.0

    def __post_init__(self) -> None:
        require_count("n_updates", self.n_updates)
        require(0 <= self.p_max <= 1, "p_max", self.p_max, "a number in [0, 1]")

    def probability(self, n_done: int) -> float:
        """Probability of the mode after so many updates.

        >>> ModeSchedule(n_updates=100).probability(30)
        0.05
        """
        share = min(n_done / self.n_updates, 1.0)
        return self.p_max * (1 + math.tanh((self.steepness * share - self.delay) / 2)) / 2


class ModeAssistedState(NamedTuple):
    """States of both samplers, and how many updates were done, a scalar."""

    n_done: Tensor
    inner: Any
    mode: Any


@dataclass(frozen=True, kw_only=True, slots=True)
class ModeAssisted:
    r"""The negative phase of another sampler, corrected in some updates by the ground state.

    With the probability of ``schedule`` an update follows ``g (E(data) - E(x*))``, otherwise ``inner``.
    x* is the ground state that ``mode`` finds, and

    .. math:: g = \mathrm{clip}\left(\frac{\bar E - E(x^*)}{4 (n_{visible} + 1) (n_{hidden} + 1)}, 0, 1\right)

    with the mean energy of all joint states :math:`\bar E`, that of units without fields at their means: E(1/2,
    1/2) for units in {0, 1}. It is the depth of the ground state as a share of the largest for couplings of size
    one. In a model of any connectivity the number of couplings and biases, plus one, stands for
    :math:`(n_{visible} + 1) (n_{hidden} + 1)`, which it is for an RBM; a categorical unit counts once. The scaled
    update is written as a negative phase: x* has the weight g, the positive phase keeps 1 - g. One coin serves all
    replicas, so that a ground state is computed only when it is used. The coin is tossed and counted once a call:
    give all images of an update at once.

    Attributes:
        inner: Sampler of the other updates.
        mode: Sampler of the ground state.
        schedule: How often updates take the ground state.
    """

    uses_data: ClassVar[bool] = True
    shared: ClassVar[bool] = False

    inner: NegativePhaseSampler[Any, Any]
    mode: NegativePhaseSampler[Any, Any]
    schedule: ModeSchedule

    def __post_init__(self) -> None:
        require_sampler("inner", self.inner)
        require_sampler("mode", self.mode)

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> ModeAssistedState:
        """Start both samplers."""
        return ModeAssistedState(
            torch.zeros((), dtype=torch.long, device="cpu"),
            self.inner.init(model, n_chains, generator=generator),
            self.mode.init(model, n_chains, generator=generator),
        )

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: ModeAssistedState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[ModeAssistedState]:
        """Toss the coin, and return one negative phase or the other, with its ``info``."""
        n_done = int(state.n_done)
        state = state._replace(n_done=state.n_done + 1)
        probability = self.schedule.probability(n_done)
        if float(rng.uniform((), generator=generator)) >= probability:
            found = self.inner.sample(model, state.inner, positive, generator=generator)
            return found._replace(state=state._replace(inner=found.state))
        return self.sample_mode(model, state, positive, generator=generator)

    @torch.no_grad()
    def sample_mode(
        self, model: EnergyModel, state: ModeAssistedState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[ModeAssistedState]:
        """Return the negative phase of an update with the mode, whatever the schedule says; counts nothing."""
        found = self.mode.sample(model, state.mode, positive, generator=generator)
        scale = mode_scale(model, found.configurations)
        share, mode = scale.unsqueeze(-1), found.configurations
        mixed = Configurations(
            torch.cat((mode.v, positive.v), dim=-2),
            torch.cat((mode.h, positive.h), dim=-2),
            torch.cat((share * shares(mode), (1 - share) * shares(positive)), dim=-1),
        )
        return NegativePhase(mixed, state._replace(mode=found.state), {**found.info, "mode_scale": scale})


def mode_scale(model: EnergyModel, mode: Configurations) -> Tensor:
    """The factor g of an update with the mode, ``(*replicas,)`` in [0, 1].

    The lowest energy counts, that of real units at their means given the others.
    """
    layers = (model.visible, mode.v), (model.hidden, mode.h)
    free_v, free_h = (units.mean(torch.zeros_like(x[..., :1, :])) for units, x in layers)
    energy = model.energy(*at_real_means(model, mode)[:2]).amin(-1)
    depth = model.energy(free_v, free_h).squeeze(-1) - energy
    scale: Tensor = depth / (4 * _n_terms(model))
    return scale.clamp(0.0, 1.0)


def _n_terms(model: EnergyModel) -> int:
    """Number of coupled pairs of sites, of biases, and one more."""
    visible, hidden, pairs = model.visible, model.hidden, model.quadratic_form().pairs
    n_sites = visible.n_sites + hidden.n_sites
    if pairs is None:
        return 1 + n_sites + visible.n_sites * hidden.n_sites
    if n_sites == model.n_units:
        return 1 + n_sites + len(pairs)
    site_of = torch.cat((visible.site_of(), hidden.site_of() + visible.n_sites)).to(pairs.device)
    sites = site_of[pairs]
    return 1 + n_sites + len(torch.unique(sites[:, 0] * n_sites + sites[:, 1]))
