"""Effective couplings by series: the same as pair by pair."""

import importlib

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, couplings
from memcomp_lightning.models import Normal as Weights
from memcomp_lightning.models.pair_series import couplings_by_series
from memcomp_lightning.models.units import Bernoulli, Gaussian, Mixed, ReLU, Spin

module = importlib.import_module("memcomp_lightning.models.couplings")

HIDDEN = {
    "bits": Bernoulli(6),
    "spins": Spin(6),
    "real": Gaussian(6, variance=0.7, learned=False),
    "rectified": ReLU(6),
    "mixed": Mixed(Spin(2), Bernoulli(4)),
}


def pair_by_pair(hidden, weight, c):
    return weight.new_zeros(weight.shape[-1], weight.shape[-1]), torch.arange(len(weight))


@pytest.mark.parametrize("visible", [Bernoulli(9), Mixed(Bernoulli(4), Spin(5))], ids=["bits", "bits and spins"])
@pytest.mark.parametrize("hidden", HIDDEN)
def test_couplings_are_those_of_all_pairs(hidden, visible, monkeypatch):
    rbm = RBM(visible=visible, hidden=HIDDEN[hidden], weight_init=Weights(std=0.6), generator=rng.stream(0, "w"))
    with torch.no_grad():
        rbm.c.copy_(torch.linspace(-1, 1, 6))
        rbm.weight[2] = 0.0
        rbm.weight[4, 3] = 6.0  # larger than all else: no series is smooth enough
    w = rbm.weight.detach().double()
    _, slow = couplings_by_series(rbm.hidden, w, rbm.c.detach().double())
    assert 4 in slow.tolist() or hidden == "real"
    assert len(slow) < 6
    found = couplings(rbm)
    monkeypatch.setattr(module, "couplings_by_series", pair_by_pair)
    expected = couplings(rbm)
    assert expected.J.abs().max() > 0.05
    torch.testing.assert_close(found.J, expected.J, rtol=0, atol=1e-10)
    torch.testing.assert_close(found.h, expected.h, rtol=0, atol=1e-10)


def test_two_spins_are_coupled_as_the_sum_over_the_hidden_states_says():
    rbm = RBM(visible=Spin(2), n_hidden=3, weight_init=Weights(std=0.5), generator=rng.stream(1, "w")).double()
    v = torch.tensor([[1.0, 1], [1, -1], [-1, 1], [-1, -1]]).double()
    log_p = -rbm.free_energy(v).detach()
    assert couplings(rbm).J[0, 1].item() == pytest.approx(float(log_p @ v.prod(-1)) / 4, abs=1e-12)
