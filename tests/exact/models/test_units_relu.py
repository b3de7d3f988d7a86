"""ReLU units far from zero, against scipy and quadrature."""

import numpy as np
import pytest
import torch
from scipy import special, stats

from memcomp_lightning import rng
from memcomp_lightning.models.units import ReLU
from memcomp_lightning.testing import brute_force

FIELDS = [-1000.0, -60.0, -41.0, -39.0, -20.0, -8.1, -7.9, -3.0, 0.0, 3.0, 8.4, 8.6, 30.0, 1000.0]


def moments(field):
    """Mean, standard deviation and log of the integral of exp(f x - x^2 / 2), x = y / scale."""
    scale = max(1.0, -field)
    node, log_width = brute_force._rule(torch.tensor([max(field, 0.0)]).double(), torch.ones(()).double(), 0.0)
    if field < 0:
        node, log_width = 4 * node / scale, log_width + np.log(4 / scale)
    log_weight = field * node - node.square() / 2 + log_width
    p = log_weight.softmax(0)
    mean = (p * node).sum()
    return mean, (p * (node - mean).square()).sum().sqrt(), log_weight.logsumexp(0)


@pytest.mark.parametrize("field", FIELDS)
def test_means_points_and_cumulants(field):
    mean, deviation, cumulant = moments(field)
    for dtype, tolerance, of_points in ((torch.float64, 1e-10, 1e-7), (torch.float32, 3e-5, 1e-3)):
        x = torch.full((1, 1), field, dtype=dtype)
        for found, true, allowed in (
            (ReLU(1).mean(x), mean, tolerance),
            (ReLU(1).cumulant(x), cumulant, tolerance),
            (ReLU(1).points(x)[0] - ReLU(1).mean(x), deviation, of_points * max(1.0, float(mean / deviation))),
        ):
            assert found.dtype == dtype
            torch.testing.assert_close(found.double().squeeze(), true, rtol=allowed, atol=0)
        upper, lower = ReLU(1).points(x)
        assert float(lower) >= 0
        assert float(upper) > float(lower)


@pytest.mark.parametrize("field", [-100.0, -31.0, -29.0, -12.0, -8.5, -5.0, 0.0, 12.0])
def test_samples_follow_the_truncated_normal_distribution(field):
    x = ReLU(1).sample(torch.full((20_000, 1), field, dtype=torch.float64), generator=rng.stream(0, "samples"))
    above = np.exp(special.log_ndtr(field - x.numpy().ravel()) - special.log_ndtr(field))
    assert stats.kstest(above, "uniform").pvalue > 1e-7
    hotter = np.exp(special.log_ndtr(field - 1.1 * x.numpy().ravel()) - special.log_ndtr(field))
    assert stats.kstest(hotter, "uniform").pvalue < 1e-7


def test_biases_have_the_means():
    mean = torch.tensor([[0.02, 0.3, 1.0, 20.0]], dtype=torch.float64)
    torch.testing.assert_close(ReLU(4).mean(ReLU(4).bias_of(7 * mean, 7)), mean)
