"""Exact likelihoods of models small enough to be enumerated, and pseudo-likelihoods, which need no log Z."""

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states, bits
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.likelihood.boltzmann import (
    log_hidden_sum,
    log_likelihood_bound,
    log_partition_function_by_classes,
)
from memcomp_lightning.likelihood.layers import NUMBERS, enumerable, in_chunks, log_weights, softplus
from memcomp_lightning.likelihood.prefixes import N_SECOND, prefix_log_weights
from memcomp_lightning.models.base import EnergyModel, Images, PerReplica, PerState, Visible, as_two_layers
from memcomp_lightning.models.rbm import RBM

MOST_HIDDEN = 16
"""Hidden units of a Boltzmann machine that are enumerated for each image at most."""


@torch.no_grad()
def log_partition_function(model: EnergyModel, *, max_units: int = 25, progress: bool = False) -> PerReplica:
    r"""Return log Z in float64, by enumerating the smaller layer.

    .. math:: Z = \sum_s exp(g.s) \prod_i (1 + exp(W s + c)_i)

    over the states s of the smaller layer, with bias g, and the units i of the other one. Time grows as
    2^n_smaller n_other, about 5e9 such pairs a second and CPU thread. A Boltzmann machine of two classes of units
    is taken as such an RBM (``two_layers``); of any other all units outside the largest class are enumerated.

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
    if two_layers is None:
        return log_partition_function_by_classes(model, max_units)
    layers = enumerable(two_layers.rbm, max_units)
    return prefix_log_weights(layers, progress=progress).logsumexp(-1).reshape(model.replicas)


@torch.no_grad()
def exact_samples(model: RBM, n: int, *, generator: Generator, max_units: int = 25) -> Visible:
    """Draw n >= 1 independent visible states a replica, by enumerating the smaller layer.

    It may have up to ``max_units`` units, which is 1 to 32.

    Raises:
        SettingError: As :func:`log_partition_function`.
    """
    require_count("n", n)
    layers = enumerable(model, max_units)
    n_second = min(N_SECOND, layers.n_enumerated)
    prefix = _draw(prefix_log_weights(layers, n_second=n_second), n, generator=generator)
    second = binary_states(n_second, like=layers.weight)
    rows = max(1, NUMBERS // (len(layers.weight) * layers.n_other * len(second)))
    rest = []
    for part in prefix.split(rows, dim=-1):
        log_weight = log_weights(layers, bits(part, layers.n_enumerated - n_second, like=second), second)
        rest.append(_draw(log_weight, 1, generator=generator))
    number = prefix * len(second) + torch.cat(rest, dim=1).squeeze(-1)
    states = bits(number, layers.n_enumerated, like=model.b)
    states = states.reshape(*model.replicas, n, layers.n_enumerated)
    return rng.bernoulli(model.visible_mean(states), generator=generator) if layers.hidden_first else states


def _draw(log_weight: Tensor, n: int, *, generator: Generator) -> Tensor:
    """Draw n indices of the last axis for each distribution, by inversion: ``(..., n)`` int64."""
    cumulative = torch.softmax(log_weight, dim=-1).cumsum(-1)
    cumulative = cumulative / cumulative[..., -1:]
    u = rng.uniform((*cumulative.shape[:-1], n), generator=generator, like=cumulative)
    # right=True finds the first value above u, so that a state of probability zero is never drawn.
    return torch.searchsorted(cumulative, u, right=True)


@torch.no_grad()
def log_likelihood(model: EnergyModel, v: Images, log_z: PerReplica) -> PerState:
    """Return log p(v) = -F(v) - log Z of each image, in nats and float64.

    In a Boltzmann machine whose hidden units are coupled to each other they are enumerated for each image, but for
    their largest class: up to 16 of them. For more, see :func:`log_likelihood_bound`.

    Images are in {0, 1}, ``(*replicas, n, n_visible)``, or without replica axes for the same images everywhere.
    Log Z may be exact or estimated.

    Raises:
        SettingError: v is not binary or has the wrong shape; too many hidden units would have to be enumerated.
    """
    v = _binary(model, v)
    parameters = _of_rbm(model)
    if parameters is None:
        return log_hidden_sum(model, v, max_units=MOST_HIDDEN) - log_z.double().unsqueeze(-1)
    weight, b, c = parameters

    def minus_free_energy(rows: Tensor) -> Tensor:
        field = rows @ weight.mT + c.unsqueeze(-2)
        return softplus(field).sum(-1) + (rows @ b.unsqueeze(-1)).squeeze(-1)

    return in_chunks(minus_free_energy, v, model.n_visible + model.n_hidden) - log_z.double().unsqueeze(-1)


def log_likelihood_or_bound(model: EnergyModel, v: Images, log_z: PerReplica) -> PerState:
    """:func:`log_likelihood`, or :func:`log_likelihood_bound` of a machine with more than 16 hidden units."""
    if model.n_hidden > MOST_HIDDEN and model.quadratic_form().pairs is not None:
        return log_likelihood_bound(model, v, log_z)
    return log_likelihood(model, v, log_z)


@torch.no_grad()
def kl_divergence(model: EnergyModel, v: Images, log_z: PerReplica | None = None) -> PerReplica:
    r"""Return the divergence of the model from the empirical distribution of the rows of v, in nats and float64.

    .. math:: KL(p_v || p) = \sum_x p_v(x) (log p_v(x) - log p(x))

    over the different rows x, p_v(x) being the share of the rows that are x. States without a row add nothing.
    Images are those of :func:`log_likelihood`; without log Z, :func:`log_partition_function` enumerates.

    Raises:
        SettingError: v is not binary or has the wrong shape; the smaller layer is too large to enumerate.
    """
    require_count("number of rows of v", _binary(model, v).shape[-2])
    log_p = log_likelihood(model, v, log_partition_function(model) if log_z is None else log_z)
    n = v.shape[-2]
    log_shares = torch.stack([_log_shares(rows) for rows in v.reshape(-1, n, v.shape[-1])])
    return (log_shares.reshape(*v.shape[:-2], n) - log_p).mean(-1)


def _log_shares(rows: Tensor) -> Tensor:
    """Log of the share of the rows that equal each row, ``(n,)`` float64."""
    _, at, counts = torch.unique(rows, dim=0, return_inverse=True, return_counts=True)
    log_shares: Tensor = (counts[at].double() / len(rows)).log()
    return log_shares


@torch.no_grad()
def log_pseudo_likelihood(model: EnergyModel, v: Images) -> Visible:
    r"""Return log p(v_j | all other v) of each unit j of each image in float64; needs no log Z.

    .. math:: log p(v_j | v_{-j}) = -softplus(F(v) - F(v'))

    where v' is v with unit j flipped. (Besag 1975.) In an RBM its hidden field differs from that of v by one
    column of W; in a Boltzmann machine the hidden units, up to 16 outside their largest class, are enumerated.
    The images are those of :func:`log_likelihood`; the log pseudo-likelihood of one is the sum over the last axis.

    Raises:
        SettingError: v is not binary or has the wrong shape; too many hidden units would have to be enumerated.
    """
    v = _binary(model, v)
    parameters = _of_rbm(model)
    if parameters is None:
        flips = torch.eye(model.n_visible, dtype=torch.float64, device=v.device)

        def of_images(rows: Tensor) -> Tensor:
            flipped = (rows.unsqueeze(-2) - flips).abs()
            log_sums = log_hidden_sum(model, flipped.flatten(-3, -2), max_units=MOST_HIDDEN)
            log_sum = log_hidden_sum(model, rows, max_units=MOST_HIDDEN).unsqueeze(-1)
            return -softplus(log_sums.unflatten(-1, flipped.shape[-3:-1]) - log_sum)

        return in_chunks(of_images, v, model.n_visible * model.n_units)
    weight, b, c = parameters

    def of_rows(rows: Tensor) -> Tensor:
        field = rows @ weight.mT + c.unsqueeze(-2)
        change = 1 - 2 * rows
        flipped = change.unsqueeze(-1) * weight.mT.unsqueeze(-3) + field.unsqueeze(-2)
        gain = change * b.unsqueeze(-2) + softplus(flipped).sum(-1) - softplus(field).sum(-1, keepdim=True)
        return -softplus(gain)

    return in_chunks(of_rows, v, model.n_visible * model.n_hidden)


def _binary(model: EnergyModel, v: Tensor) -> Tensor:
    """Images with the model's replica axes."""
    replicas = model.replicas
    fits = v.ndim >= 2 and v.shape[-1] == model.n_visible and v.shape[:-2] in ((), replicas)
    allowed = f"(n, {model.n_visible}), or with the replica axes {replicas} in front of it"
    require(fits, "shape of v", tuple(v.shape), allowed)
    other = v[(v != 0) & (v != 1)]
    remedy = "Grey values have no likelihood under a Bernoulli RBM: binarise the images, say v > 0.5."
    require(not len(other), "v", float(other[0]) if len(other) else 0.0, "values in {0, 1}", remedy)
    return v.expand(*replicas, *v.shape[-2:])


def _of_rbm(model: EnergyModel) -> tuple[Tensor, Tensor, Tensor] | None:
    """Weights and both biases in float64, if the model is an RBM: sums over h have a closed form then."""
    if model.quadratic_form().pairs is not None:
        return None
    rbm = as_two_layers(model).rbm
    return rbm.weight.double(), rbm.b.double(), rbm.c.double()
