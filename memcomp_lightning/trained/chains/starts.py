"""Starts of chains that are further apart than the model's own states, so that chains that do not mix disagree."""

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, EnergyModel
from memcomp_lightning.models.base import Chains
from memcomp_lightning.models.clamped import ClampedChains

N_COOLING = 48
"""Sweeps from infinite temperature to that of the model."""

WIDEST = 6.0
"""Fields of the hidden units in patterns: from hardly any that is on to hardly any that is off."""


def overdispersed(model: EnergyModel, chains: Chains, n: int, *, generator: Generator) -> Tensor:
    """States of n chains, each third of another kind.

    * Random states, as at infinite temperature: they fall into the widest modes.
    * The same, cooled slowly: they find modes that are deep.
    * Patterns: visible units given hidden ones of which few, many or nearly all are on. They find modes that a few
      hidden units make, and that neither heat nor cold leads to.

    Args:
        model: Whose chains these are.
        chains: Its chains, some of its units known perhaps.
        n: How many.
        generator: Random stream.
    """
    random = chains.random(n, generator=generator)
    cooled = random
    for step in range(1, N_COOLING + 1):
        cooled = chains.sweep(cooled, beta=step / N_COOLING, generator=generator)
    kinds = [random, cooled]
    if model.n_hidden:
        kinds.append(_patterns(model, chains, random, generator))
    number = torch.arange(n, device=random.device)
    return torch.stack(kinds)[number % len(kinds), number]


def _patterns(model: EnergyModel, chains: Chains, random: Tensor, generator: Generator) -> Tensor:
    """The visible units given hidden ones of all shares of those that are on."""
    n = len(random)
    share = WIDEST * (2 * rng.uniform((n, 1), generator=generator, like=random) - 1)
    noise = torch.empty(n, model.n_hidden, dtype=random.dtype, device=generator.device)
    field = share + 2 * noise.normal_(generator=generator).to(random.device)
    h = model.hidden.sample(field, generator=generator)
    if isinstance(model, RBM) and not isinstance(chains, ClampedChains):
        return model.draw_visible(h, generator=generator)
    # The class with most visible units is drawn first.
    return chains.sweep(torch.cat((random[:, : model.n_visible], h), dim=-1), generator=generator)
