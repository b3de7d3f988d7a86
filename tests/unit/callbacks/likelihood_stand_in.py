"""What callback and metrics ask of ``memcomp_lightning.likelihood``, by enumeration of few units."""

import importlib
import importlib.util
import sys
from types import ModuleType
from typing import Any, NamedTuple

import pytest
import torch
from torch import Generator, Tensor

from memcomp_lightning.models.enumeration import binary_states


class AisEstimate(NamedTuple):
    log_z: Tensor
    standard_error: Tensor
    effective_sample_size: Tensor
    log_weights: Tensor


class Ais:
    """Exact; how it was asked shows in the numbers beside."""

    def __init__(self, n_chains: int, n_betas: int) -> None:
        self.n_chains, self.n_betas = n_chains, n_betas

    def estimate(self, model: Any, *, generator: Generator, base: Tensor | None = None) -> AisEstimate:
        assert base is not None
        assert base.shape == model.b.shape
        log_z = log_partition_function(model)
        error, size = torch.full_like(log_z, 0.1), torch.full_like(log_z, self.n_chains)
        return AisEstimate(log_z, error, size, log_z.unsqueeze(-1))


def base_of(v: Tensor) -> Tensor:
    n_on = v.sum(-2)
    return torch.log((n_on + 1) / (v.shape[-2] - n_on + 1))


def log_partition_function(model: Any, *, max_units: int = 25) -> Tensor:
    states = binary_states(model.n_visible, like=model.b).expand(*model.replicas, -1, -1)
    return (-model.free_energy(states).double()).logsumexp(-1)


def log_likelihood(model: Any, v: Tensor, log_z: Tensor) -> Tensor:
    assert bool(((v == 0) | (v == 1)).all()), "grey images have no likelihood"
    return -model.free_energy(v).double() - log_z.unsqueeze(-1)


def log_pseudo_likelihood(model: Any, v: Tensor) -> Tensor:
    gains = []
    for unit in range(model.n_visible):
        flipped = v.clone()
        flipped[..., unit] = 1 - flipped[..., unit]
        gains.append(model.free_energy(flipped) - model.free_energy(v))
    return torch.nn.functional.logsigmoid(torch.stack(gains, dim=-1).double())


def provide(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand in for the package, or for what it does not have."""
    name = "memcomp_lightning.likelihood"
    if importlib.util.find_spec(name) is None:
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    module = importlib.import_module(name)
    for own in (Ais, AisEstimate, base_of, log_partition_function, log_likelihood, log_pseudo_likelihood):
        if not hasattr(module, own.__name__):
            monkeypatch.setattr(module, own.__name__, own, raising=False)
