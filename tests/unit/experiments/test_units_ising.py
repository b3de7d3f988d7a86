"""Samples of grids, and couplings read from models."""

import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.models.units import Spin

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "units"))
import ising


@pytest.mark.parametrize("kind", ["-0.5 and 0.5", "Gaussian"])
def test_the_grid_is_sampled_exactly(kind):
    grid = ising.Grid.draw(3, kind, rng.numpy_stream(1, "grid"))
    states = np.array(list(product((-1, 1), repeat=9)), dtype=float).reshape(-1, 3, 3)
    log_z = np.logaddexp.reduce(-grid.energy(states))
    n = 20_000
    drawn, found = grid.sample(n, rng.numpy_stream(2, "grid"))
    assert found == pytest.approx(log_z)
    p = np.exp(-grid.energy(states) - log_z)
    number = ((drawn.reshape(n, 9) + 1) / 2 @ 2 ** np.arange(8, -1, -1)).astype(int)
    counts = np.bincount(number, minlength=512)

    def chi2(expected):
        return ((counts - n * expected) ** 2 / (n * expected)).sum()

    assert abs(chi2(p) - 511) < 6 * (2 * 511) ** 0.5
    turned = grid._replace(right=-grid.right)
    other = np.exp(-turned.energy(states))
    assert abs(chi2(other / other.sum()) - 511) > 20 * (2 * 511) ** 0.5


def test_effective_couplings_of_units_with_two_connections_are_the_known_ones():
    # A hidden spin that two visible ones are coupled to is a coupling of atanh(tanh(w) tanh(u)) between these.
    rbm = RBM(visible=Spin(4), hidden=Spin(2), replicas=(1,), weight_init=Normal(std=0.0))
    with torch.no_grad():
        rbm.weight[0] = torch.tensor([[0.7, -0.5, 0.0, 0.0], [0.0, 0.3, 0.0, 0.9]])
        rbm.b[0] = torch.tensor([0.1, 0.2, -0.3, 0.0])
    contexts = 2 * rng.bernoulli(torch.full((1, 10, 4), 0.5), generator=rng.stream(0, "contexts")) - 1
    coupling, field = ising.effective(rbm, contexts)
    expected = np.zeros((4, 4))
    expected[0, 1] = np.arctanh(np.tanh(0.7) * np.tanh(-0.5))
    expected[1, 3] = np.arctanh(np.tanh(0.3) * np.tanh(0.9))
    np.testing.assert_allclose(coupling[0], expected + expected.T, atol=1e-6)
    np.testing.assert_allclose(field[0], rbm.b[0].detach().numpy(), atol=1e-6)
