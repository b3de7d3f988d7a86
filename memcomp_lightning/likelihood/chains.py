"""Whether chains are samples of their model."""

import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.likelihood.ais import Ais, ReverseAis
from memcomp_lightning.models.base import PerReplica, Visible
from memcomp_lightning.models.rbm import RBM

MOST_BEHIND = 1.0
"""Nats by which log Z from chains may stay below log Z by annealing."""


def stopped_mixing(gap: float) -> str:
    """What a gap above :data:`MOST_BEHIND` means."""
    return f"the chains have stopped mixing: log Z from them is {gap:.1f} nats below log Z by annealing"


@torch.no_grad()
def gap_of_chains(
    rbm: RBM,
    chains: Visible,
    *,
    base: Tensor | None = None,
    n_chains: int = 100,
    n_betas: int = 300,
    seed: int = 0,
) -> PerReplica:
    """Log Z by annealing less log Z by reverse annealing from chains, in nats.

    It is about 0 where the chains are samples of the model. Chains that sit in modes of little weight give a log
    Z that is too low, by ten nats and more; chains that are not there yet may give one that is too high.

    Args:
        rbm: The model.
        chains: Visible states, ``(*replicas, n, n_visible)``, n >= 2.
        base: As that of ``Ais.estimate``.
        n_chains: Of annealing upwards, >= 2.
        n_betas: Steps of either way, >= 1.
        seed: Of the draws.
    """
    up = Ais(n_chains=n_chains, n_betas=n_betas).estimate(rbm, generator=rng.stream(seed, "ais"), base=base)
    return up.log_z - log_z_from_chains(rbm, chains, base=base, n_betas=n_betas, seed=seed)


def log_z_from_chains(
    rbm: RBM, chains: Visible, *, base: Tensor | None = None, n_betas: int = 300, seed: int = 0
) -> PerReplica:
    """Log Z by annealing from chains down to independent units; arguments are those of :func:`gap_of_chains`."""
    generator = rng.stream(seed, "from chains")
    return ReverseAis(n_betas=n_betas).estimate(rbm, chains, generator=generator, base=base).log_z
