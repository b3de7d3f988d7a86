"""How likely data are under a deep belief network: a lower bound, from its recognition model."""

import copy
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import Images, PerReplica
from memcomp_lightning.models.generative import GenerativeDBN

ROWS = 1000
"""Rows at once."""


class RecognitionBound(NamedTuple):
    """A lower bound of log p(v), as an average over draws of the recognition model.

    Attributes:
        value: ``(*replicas, n)`` float64, in nats.
        standard_error: Of the average over draws, of the same shape.
    """

    value: Tensor
    standard_error: Tensor


@torch.no_grad()
def recognition_bound(
    model: GenerativeDBN, v: Images, log_z: PerReplica, *, n_draws: int = 10, generator: Generator
) -> RecognitionBound:
    r"""Return a lower bound of log p(v) of each row.

    .. math:: \log p(v) \ge E_q[\log p(v, h)] + H(q) = E_q[\log p(v, h) - \log q(h | v)]

    with the hidden units of the top RBM, and its labels, summed out (Salakhutdinov & Murray 2008). The average
    over draws has the bound as its mean; where q is the true posterior every draw is log p(v). A ``log_z`` from
    AIS is too low on average, and the bound then too high.

    Args:
        model: Of any dtype; computed in float64.
        v: Values of the inputs, ``(*replicas, n, n_visible)``, or without replica axes.
        log_z: Log of the partition function of ``model.top``, ``(*replicas,)``.
        n_draws: Draws of the recognition model a row, >= 2.
        generator: Random stream.

    Raises:
        SettingError: v has values that the units do not take, or the wrong shape.
    """
    require_count("n_draws", n_draws, minimum=2)
    n = model.visible.n
    fits = v.ndim >= 2 and v.shape[-1] == n and v.shape[:-2] in ((), model.replicas)
    require(
        fits, "shape of v", tuple(v.shape), f"(n, {n}), or with the replica axes {model.replicas} in front of it"
    )
    model.visible.check(v, pure=True)
    wide = copy.deepcopy(model).double()
    v = v.double().expand(*model.replicas, *v.shape[-2:])
    parts = [_log_weights(wide, rows, n_draws, generator) for rows in v.split(ROWS, dim=-2)]
    found = torch.cat(parts, dim=-1) - log_z.double().unsqueeze(-1)
    return RecognitionBound(found.mean(0), found.std(0) / n_draws**0.5)


def _log_weights(model: GenerativeDBN, v: Tensor, n_draws: int, generator: Generator) -> Tensor:
    """Log p(v, h) + log Z - log q(h | v) of draws, ``(n_draws, *replicas, n)``."""
    found = []
    for _ in range(n_draws):
        states = model.up(v, generator=generator)
        log_w = model.log_weight(states[-1])
        for number, (down, up) in enumerate(zip(model.downward, model.upward, strict=True)):
            below, above = states[number], states[number + 1]
            log_w = log_w + down.log_prob(below, above) - up.log_prob(above, below)
        found.append(log_w)
    return torch.stack(found)
