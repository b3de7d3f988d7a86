"""The Gibbs sweep, written out as a transition matrix."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.models import chains
from memcomp_lightning.models.units import Bernoulli
from memcomp_lightning.testing.conformance import small_rbm


@pytest.fixture
def transition_matrix(monkeypatch):
    """Builds K(v, v') out of ``sweep`` itself: its draws are replaced by every outcome in turn."""

    def build(rbm, beta):
        v = binary_states(rbm.n_visible, like=rbm.b)
        kernel = torch.zeros(len(v), len(v), dtype=torch.float64)
        for h in binary_states(rbm.n_hidden, like=rbm.b):
            outcomes, probabilities = [h.expand(len(v), -1), v], []

            def scripted(self, field, *, generator, outcomes=outcomes, probabilities=probabilities):
                probabilities.append(torch.sigmoid(field))
                return outcomes[len(probabilities) - 1]

            monkeypatch.setattr(Bernoulli, "sample", scripted)
            chains.sweep(rbm, v, beta=beta, generator=rng.stream(0, "unused"))
            p_hidden, p_visible = probabilities
            to_h = (p_hidden * h + (1 - p_hidden) * (1 - h)).prod(-1)
            to_v = (p_visible[0] * v + (1 - p_visible[0]) * (1 - v)).prod(-1)
            kernel += to_h[:, None] * to_v
        monkeypatch.undo()
        return kernel

    return build


def boltzmann(rbm, beta):
    """p(v) at inverse temperature beta, from the joint energies."""
    v, h = binary_states(rbm.n_visible, like=rbm.b), binary_states(rbm.n_hidden, like=rbm.b)
    energy = -(v @ rbm.weight.mT @ h.mT) - (v @ rbm.b)[:, None] - h @ rbm.c
    return torch.softmax(-beta * energy.flatten(), 0).view(len(v), len(h)).sum(-1)


@pytest.mark.parametrize("beta", [1.0, 0.7])
@pytest.mark.parametrize("sizes", [(7, 5), (5, 7)], ids=str)
@torch.no_grad()
def test_boltzmann_distribution_is_stationary(transition_matrix, sizes, beta):
    rbm = small_rbm(*sizes).double()
    kernel, pi = transition_matrix(rbm, beta), boltzmann(rbm, beta)
    torch.testing.assert_close(kernel.sum(-1), torch.ones_like(pi))
    torch.testing.assert_close(pi @ kernel, pi, rtol=0, atol=1e-14)


@torch.no_grad()
def test_distribution_at_another_temperature_is_not_stationary(transition_matrix):
    rbm = small_rbm().double()
    kernel, pi = transition_matrix(rbm, 0.7), boltzmann(rbm, 1.0)
    assert (pi @ kernel - pi).abs().max() > 1e-3


@torch.no_grad()
def test_kernel_reaches_every_state(transition_matrix):
    assert transition_matrix(small_rbm().double(), 1.0).min() > 0
