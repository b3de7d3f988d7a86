"""Likelihoods of machines of any connectivity: what is special to them, on top of those of RBMs."""

import copy
import math
from typing import TypeVar

import torch
from torch import Tensor

from memcomp_lightning.errors import require_count
from memcomp_lightning.likelihood.layers import NUMBERS, in_chunks
from memcomp_lightning.models.base import Block, EnergyModel, Images, PerReplica, PerState
from memcomp_lightning.models.machine import log2_states, require_few_bits
from memcomp_lightning.models.mean_field import free_energy_of_means, hidden_blocks, mean_field
from memcomp_lightning.models.units import Units, all_states

ModelT = TypeVar("ModelT", bound=EnergyModel)


def base_on_first_class(model: EnergyModel, base: Tensor) -> Tensor:
    """Turn a base for the visible units into one for the first class, with zeros for its hidden units."""
    units = model.classes[0]
    wide = base.new_zeros(*base.shape[:-1], model.n_units)
    wide[..., : model.n_visible] = base
    return wide[..., units]


@torch.no_grad()
def log_partition_function_by_classes(model: EnergyModel, max_units: int) -> PerReplica:
    """Log Z by enumerating all units outside the largest class."""
    model = double_of(model)
    largest, others, kind = model.outside_largest_class()
    _require_few(kind, max_units, "Estimate log Z (Ais).")
    rows = max(1, NUMBERS // (model.n_units * max(1, math.prod(model.replicas))))
    parts = []
    for numbers in torch.arange(kind.n_states, device=model.b.device).split(rows):
        states = kind.states(numbers, like=model.b.detach())
        x = states.new_zeros(*model.replicas, len(states), model.n_units)
        x[..., others] = states
        parts.append(_summed_over(model, largest, x).logsumexp(-1))
    return torch.stack(parts).logsumexp(0)


@torch.no_grad()
def log_hidden_sum(model: EnergyModel, v: Tensor, max_units: int) -> PerState:
    """Log of the sum over h of exp(-E(v, h)), by enumerating all hidden units outside their largest class."""
    model = double_of(model)
    v = v.double().expand(*model.replicas, *v.shape[-2:])
    if model.n_hidden == 0:
        return -model.energy(v, v[..., :0])
    largest = max(hidden_blocks(model), key=lambda block: len(block.units))
    hidden = torch.arange(model.n_visible, model.n_units, device=v.device)
    others = _without(hidden, largest.units)
    kind = model.hidden.select(others - model.n_visible)
    _require_few(kind, max_units, "Use log_likelihood_bound.")
    states = all_states(kind, v)

    def of_images(some: Tensor) -> Tensor:
        x = some.new_zeros(*some.shape[:-1], len(states), model.n_units)
        x[..., : model.n_visible] = some.unsqueeze(-2)
        x[..., others] = states
        log_sums: Tensor = _summed_over(model, largest, x.flatten(-3, -2)).unflatten(-1, x.shape[-3:-1])
        return log_sums.logsumexp(-1)

    return in_chunks(of_images, v, len(states) * model.n_units)


@torch.no_grad()
def log_likelihood_bound(
    model: EnergyModel, v: Images, log_z: PerReplica, *, max_iterations: int = 100, tolerance: float = 1e-4
) -> PerState:
    r"""Return the mean-field lower bound of log p(v).

    .. math:: \log p(v) \ge -E(v, \mu) + \sum_i H(\mu_i) - \log Z

    with the means :math:`\mu` of :func:`memcomp_lightning.models.mean_field` and their entropies H
    (Salakhutdinov & Hinton 2009). Equal to log p(v) if no two hidden units are coupled. The images are values
    of the visible units and may be without replica axes. A log Z from AIS is too low on average, and the bound
    then too high.
    """
    require_count("max_iterations", max_iterations)
    model = double_of(model)
    v = v.double().expand(*model.replicas, *v.shape[-2:])
    found = []
    for some in v.split(10_000, dim=-2):
        h = mean_field(model, some, max_iterations=max_iterations, tolerance=tolerance).h
        found.append(-free_energy_of_means(model, some, h))
    return torch.cat(found, dim=-1) - log_z.double().unsqueeze(-1)


def _summed_over(model: EnergyModel, block: Block, x: Tensor) -> Tensor:
    """Log of the sum of exp(-E) over the units of a block, which are 0 in x."""
    energy = model.energy(x[..., : model.n_visible], x[..., model.n_visible :])
    return block.kind.cumulant(block.field(x)).sum(-1) - energy


def double_of(model: ModelT) -> ModelT:
    """The model in float64, a copy where it is not."""
    return model if model.b.dtype == torch.float64 else copy.deepcopy(model).double()


def _without(units: Tensor, some: Tensor) -> Tensor:
    return units[~torch.isin(units, some)]


def _require_few(kind: Units, max_units: int, remedy: str) -> None:
    n_units = log2_states(kind)
    allowed = f"at most max_units = {max_units}, because all their states are enumerated"
    require_few_bits("units outside the largest class", n_units, max_units, allowed, remedy)
