"""Log Z from below and from above: annealed importance sampling both ways, beginning at training rows."""

from typing import NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require_count
from memcomp_lightning.likelihood.ais import Ais, AisEstimate, ReverseAis, base_of
from memcomp_lightning.likelihood.boltzmann import base_on_first_class
from memcomp_lightning.models.base import EnergyModel, Images, PerReplica
from memcomp_lightning.models.chains import sweep
from memcomp_lightning.models.rbm import RBM


class BothWays(NamedTuple):
    """Two estimates of the same log Z.

    Attributes:
        up: By ``Ais``, which tends to be too small.
        down: By ``ReverseAis``, which tends to be too large where its chains have reached the model.
    """

    up: AisEstimate
    down: AisEstimate

    @property
    def log_z(self) -> PerReplica:
        """The larger one, which flatters no model: its likelihoods are the lower ones."""
        return torch.maximum(self.up.log_z, self.down.log_z)

    @property
    def standard_error(self) -> PerReplica:
        """That of the larger one."""
        return torch.where(self.gap > 0, self.up.standard_error, self.down.standard_error)

    @property
    def gap(self) -> PerReplica:
        """``up.log_z - down.log_z``; below zero the true value lies in between, if the chains are the model's."""
        return self.up.log_z - self.down.log_z

    def agree(self, within: float = 1.0) -> Tensor:
        """Whether they differ by at most so many nats, ``(*replicas,)`` bool."""
        return self.gap.abs() <= within


@torch.no_grad()
def estimate_both_ways(
    model: EnergyModel,
    v: Images,
    *,
    n_chains: int = 100,
    n_betas: int = 1000,
    n_sweeps: int = 200,
    seed: int = 0,
) -> BothWays:
    """Estimate log Z upwards from independent units, and downwards from chains that begin at training rows.

    Both paths begin, or end, at independent units with the means of the rows.

    Args:
        model: An RBM or a Boltzmann machine of any connectivity, a DBM or a semi-restricted machine, say.
        v: Training rows, values of the units, ``(*replicas, n, n_visible)`` or without replica axes. The first
            ``n_chains`` of them, again and again if there are fewer, start the chains down: shuffle sorted rows.
        n_chains: Chains of either way, >= 2.
        n_betas: Steps of either way, >= 1.
        n_sweeps: Gibbs sweeps from the rows to where ``ReverseAis`` begins, >= 0. Chains that do not mix stay near
            the rows: then the upper value is no bound, and a gap tells.
        seed: Of all draws.

    Raises:
        SettingError: A setting out of range; rows of another shape.
    """
    require_count("n_sweeps", n_sweeps, minimum=0)
    base = base_of(v, model.visible)
    up = Ais(n_chains=n_chains, n_betas=n_betas).estimate(model, generator=rng.stream(seed, "ais"), base=base)
    rows = torch.arange(n_chains, device=v.device) % v.shape[-2]
    generator = rng.stream(seed, "fantasies")
    x = _chain_states(model, v[..., rows, :].to(model.b).expand(*model.replicas, -1, -1), generator)
    reverse, of_reverse = ReverseAis(n_betas=n_betas), rng.stream(seed, "reverse ais")
    layers = model.two_layers()
    if layers is None:
        chains = model.chains()
        for _ in range(n_sweeps):
            x = chains.sweep(x, generator=generator)
        return BothWays(up, reverse.estimate(model, x, generator=of_reverse, base=base))
    samples, base = layers.first(x), base_on_first_class(model, base)
    for _ in range(n_sweeps):
        samples = sweep(layers.rbm, samples, generator=generator)
    return BothWays(up, reverse.estimate(layers.rbm, samples, generator=of_reverse, base=base))


def _chain_states(model: EnergyModel, v: Tensor, generator: Generator) -> Tensor:
    """States of the model's chains with these visible units: in an RBM they are all of it."""
    if isinstance(model, RBM):
        return v
    hidden = model.hidden.values_of(model.hidden_mean(v), generator=generator)
    return torch.cat((v, hidden), dim=-1)
