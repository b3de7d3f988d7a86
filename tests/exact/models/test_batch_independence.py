"""What a model says of an image does not depend on the images that it is asked about together with."""

from typing import Any

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.likelihood import log_likelihood, log_likelihood_bound, log_pseudo_likelihood
from memcomp_lightning.models import DBM, DBN, RBM, BatchNormReluNetwork, BoltzmannMachine, Normal, mean_field

SETTINGS: dict[str, Any] = {"weight_init": Normal(std=1.5)}
MACHINES: dict[str, Any] = {
    "DBM": DBM(5, [4, 4], **SETTINGS).double(),
    "all pairs": BoltzmannMachine(5, 6, **SETTINGS).double(),
    "fully visible": BoltzmannMachine(5, 0, **SETTINGS).double(),
}
V = rng.bernoulli(torch.full((23, 5), 0.5, dtype=torch.float64), generator=rng.stream(0, "images"))
LOG_Z = torch.zeros((), dtype=torch.float64)


def one_by_one(function: Any, v: torch.Tensor, dim: int = -1) -> torch.Tensor:
    return torch.cat([function(row) for row in v.split(1, dim=-2)], dim=dim)


@pytest.mark.parametrize("model", MACHINES.values(), ids=MACHINES)
def test_of_a_machine(model: Any) -> None:
    for function in (
        model.free_energy,
        lambda v: log_likelihood_bound(model, v, LOG_Z),
        lambda v: log_likelihood(model, v, LOG_Z),
    ):
        torch.testing.assert_close(one_by_one(function, V).detach(), function(V).detach(), rtol=1e-12, atol=1e-12)
    for function in (model.hidden_mean, lambda v: log_pseudo_likelihood(model, v)):
        torch.testing.assert_close(one_by_one(function, V, -2), function(V), rtol=1e-12, atol=1e-12)


def test_mean_field_of_a_replica_is_that_of_the_replica_alone() -> None:
    """Replicas whose weights differ in size need different numbers of iterations."""
    both = BoltzmannMachine(5, 6, replicas=(2,), **SETTINGS).double()
    with torch.no_grad():
        both.coupling[0] *= 0.01
    found = mean_field(both, V.expand(2, -1, -1))
    iterations = []
    for replica in range(2):
        alone = BoltzmannMachine(5, 6).double()
        alone.load_state_dict({k: x if k == "pairs" else x[replica] for k, x in both.state_dict().items()})
        expected = mean_field(alone, V)
        iterations.append(expected.n_iterations)
        torch.testing.assert_close(found.h[replica], expected.h, rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(found.change[replica], expected.change, rtol=1e-9, atol=1e-12)
    assert iterations[0] < iterations[1] == found.n_iterations


@pytest.mark.parametrize("make", [RBM, lambda n, m: DBN(n, [m]), lambda n, m: BatchNormReluNetwork(n, [m], 2)])
def test_of_a_network(make: Any) -> None:
    network = make(5, 4).double().eval()
    torch.testing.assert_close(one_by_one(network, V, -2), network(V), rtol=1e-12, atol=1e-12)
