"""Exact likelihoods of models small enough to be enumerated."""

import math

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states, bits
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.likelihood.bits import in_bits
from memcomp_lightning.likelihood.boltzmann import (
    double_of,
    log_hidden_sum,
    log_likelihood_bound,
    log_partition_function_by_classes,
)
from memcomp_lightning.likelihood.layers import NUMBERS, enumerable, in_chunks, log_weights, require_finite
from memcomp_lightning.likelihood.prefixes import N_SECOND, prefix_log_weights
from memcomp_lightning.likelihood.values import MOST_HIDDEN, has_free_energy, has_row_sums, pure_values
from memcomp_lightning.models.base import EnergyModel, Images, PerReplica, PerState, Visible
from memcomp_lightning.models.machine import log2_states, require_few_bits
from memcomp_lightning.models.observed import check_mask, log_weight_of_hidden
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.units import all_states

_FEW = 16
"""Bits of which samples are drawn from a list of all states."""


@torch.no_grad()
def log_partition_function(model: EnergyModel, *, max_units: int = 25, progress: bool = False) -> PerReplica:
    r"""Return log Z in float64, by enumerating the smaller layer.

    .. math:: Z = \sum_s exp(g.s) \prod_i (1 + exp(W s + c)_i)

    over the states s of the smaller layer, with bias g, and the units i of the other one. Time grows as
    2^n_smaller n_other, about 5e9 such pairs a second and CPU thread. A Boltzmann machine of two classes of units
    is taken as such an RBM (``two_layers``), spins as bits; of any other machine, and of categorical and real
    units, all units outside the largest class are enumerated, and that one is summed by its cumulants.

    Args:
        model: The model, of any dtype.
        max_units: Largest smaller layer, 1 to 32.
        progress: Log an estimate of the time and show a bar.

    Raises:
        SettingError: The smaller layer has more than ``max_units`` units, or a parameter is not finite.

    >>> log_partition_function(RBM(n_visible=3, n_hidden=2)).shape
    torch.Size([])
    """
    two_layers = model.two_layers()
    binary = None if two_layers is None else in_bits(two_layers.rbm)
    if binary is None:
        require_finite(model)
        return log_partition_function_by_classes(model, max_units)
    layers = enumerable(binary.rbm, max_units)
    log_z = prefix_log_weights(layers, progress=progress).logsumexp(-1).reshape(model.replicas)
    return log_z - binary.offset


@torch.no_grad()
def exact_samples(model: RBM, n: int, *, generator: Generator, max_units: int = 25) -> Visible:
    """Draw n >= 1 independent visible states a replica, by enumerating the smaller layer.

    It may have up to ``max_units`` units, which is 1 to 32; up to 20 where units are categorical or real.

    Raises:
        SettingError: As :func:`log_partition_function`.
    """
    require_count("n", n)
    remedy = "Of a machine of two classes take as_two_layers(model).rbm, whose visible units are the first class."
    require(isinstance(model, RBM), "model", type(model).__name__, "an RBM", remedy)
    few = model.n_enumerated <= min(max_units, _FEW)  # a list of all states is faster than two halves of it
    binary = None if few else in_bits(model)
    if binary is None:
        return _samples_by_cumulants(model, n, generator, min(max_units, 20))
    layers = enumerable(binary.rbm, max_units)
    n_second = min(N_SECOND, layers.n_enumerated)
    prefix = _draw(prefix_log_weights(layers, n_second=n_second), n, generator=generator)
    second = binary_states(n_second, like=layers.weight)
    rows = max(1, NUMBERS // (len(layers.weight) * layers.n_other * len(second)))
    rest = []
    for part in prefix.split(rows, dim=-1):
        log_weight = log_weights(layers, bits(part, layers.n_enumerated - n_second, like=second), second)
        rest.append(_draw(log_weight, 1, generator=generator))
    number = (prefix * len(second) + torch.cat(rest, dim=1).squeeze(-1)).reshape(*model.replicas, n)
    # Spins are numbered as the bits that they are written in.
    if layers.hidden_first:
        return model.draw_visible(model.hidden.states(number, like=model.b), generator=generator)
    return model.visible.states(number, like=model.b)


def _samples_by_cumulants(model: RBM, n: int, generator: Generator, max_units: int) -> Tensor:
    """Visible states by the free energies of all states of the smaller layer."""
    require_finite(model)
    require_few_bits("units to enumerate", model.n_enumerated, max_units, f"at most {max_units}")
    wide, hidden_first = double_of(model), model.enumerates_hidden
    layer = model.hidden if hidden_first else model.visible
    rows = max(1, NUMBERS // (model.n_units * max(1, math.prod(model.replicas))))
    log_weight = []
    for numbers in torch.arange(layer.n_states, device=model.b.device).split(rows):
        states = layer.states(numbers, like=wide.b).expand(*model.replicas, len(numbers), layer.n)
        log_weight.append(-(wide.hidden_free_energy(states) if hidden_first else wide.free_energy(states)))
    number = _draw(torch.cat(log_weight, dim=-1), n, generator=generator)
    states = layer.states(number, like=model.b)
    return model.draw_visible(states, generator=generator) if hidden_first else states


def _draw(log_weight: Tensor, n: int, *, generator: Generator) -> Tensor:
    """Draw n indices of the last axis for each distribution, by inversion: ``(..., n)`` int64."""
    cumulative = torch.softmax(log_weight, dim=-1).cumsum(-1)
    cumulative = cumulative / cumulative[..., -1:]
    u = rng.uniform((*cumulative.shape[:-1], n), generator=generator, like=cumulative)
    # right=True finds the first value above u, so that a state of probability zero is never drawn.
    return torch.searchsorted(cumulative, u, right=True)


@torch.no_grad()
def log_likelihood(
    model: EnergyModel, v: Images, log_z: PerReplica, *, observed: Tensor | None = None
) -> PerState:
    """Return log p(v) = -F(v) - log Z of each image, in nats and float64.

    With ``observed``, a mask of the shape of v, it is log p(observed values): the missing ones are summed, and up
    to 16 hidden units are enumerated.

    In a Boltzmann machine whose hidden units are coupled to each other they are enumerated for each image, but for
    their largest class: up to 16 of them. For more, see :func:`log_likelihood_bound`.

    Images are values of the visible units, ``(*replicas, n, n_visible)``, or without replica axes for the same
    images everywhere. Of real units it is the log of a density. Log Z may be exact or estimated.

    Raises:
        SettingError: v has values that the units do not take, or the wrong shape; too many hidden units would have
            to be enumerated.
    """
    if observed is not None:
        check_mask(model, v, observed)
    v = pure_values(model, v, observed)
    if observed is not None:
        return _log_sum_of_observed(model, v, observed) - log_z.double().unsqueeze(-1)
    if not has_free_energy(model):
        return log_hidden_sum(model, v, max_units=MOST_HIDDEN) - log_z.double().unsqueeze(-1)
    wide = double_of(model)

    def minus_free_energy(rows: Tensor) -> Tensor:
        return -wide.free_energy(rows)

    return in_chunks(minus_free_energy, v, model.n_visible + model.n_hidden) - log_z.double().unsqueeze(-1)


def _log_sum_of_observed(model: EnergyModel, v: Tensor, observed: Tensor) -> Tensor:
    """Log of the sum over missing values and hidden states."""
    n = log2_states(model.hidden)
    allowed = f"at most {MOST_HIDDEN} where values are missing"
    require_few_bits("number of hidden units", n, MOST_HIDDEN, allowed)
    wide = double_of(model)
    states = all_states(model.hidden, wide.b.detach())
    states, observed = states.expand(*model.replicas, *states.shape), observed.expand(v.shape)
    rows = max(1, NUMBERS // (len(states) * max(1, math.prod(model.replicas))))
    parts = zip(v.double().split(rows, dim=-2), observed.split(rows, dim=-2), strict=True)
    return torch.cat([log_weight_of_hidden(wide, *part, states).logsumexp(-1) for part in parts], dim=-1)


def log_likelihood_or_bound(model: EnergyModel, v: Images, log_z: PerReplica) -> PerState:
    """:func:`log_likelihood`, or :func:`log_likelihood_bound` of over 16 hidden units coupled to each other."""
    if not has_row_sums(model):
        return log_likelihood_bound(model, v, log_z)
    return log_likelihood(model, v, log_z)


@torch.no_grad()
def kl_divergence(model: EnergyModel, v: Images, log_z: PerReplica | None = None) -> PerReplica:
    r"""Return the divergence of the model from the empirical distribution of the rows of v, in nats and float64.

    .. math:: KL(p_v || p) = \sum_x p_v(x) (log p_v(x) - log p(x))

    over the different rows x, p_v(x) being the share of the rows that are x. States without a row add nothing.
    Images are those of :func:`log_likelihood`; without log Z, :func:`log_partition_function` enumerates.

    Raises:
        SettingError: v has values that the units do not take, or the wrong shape; the units are real; the smaller
            layer is too large to enumerate.
    """
    require(not model.visible.real, "visible units", type(model.visible).__name__, "units that are not real")
    require_count("number of rows of v", pure_values(model, v).shape[-2])
    log_p = log_likelihood(model, v, log_partition_function(model) if log_z is None else log_z)
    n = v.shape[-2]
    log_shares = torch.stack([_log_shares(rows) for rows in v.reshape(-1, n, v.shape[-1])])
    return (log_shares.reshape(*v.shape[:-2], n) - log_p).mean(-1)


def _log_shares(rows: Tensor) -> Tensor:
    """Log of the share of the rows that equal each row, ``(n,)`` float64."""
    _, at, counts = torch.unique(rows, dim=0, return_inverse=True, return_counts=True)
    log_shares: Tensor = (counts[at].double() / len(rows)).log()
    return log_shares
