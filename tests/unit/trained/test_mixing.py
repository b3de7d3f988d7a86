"""Autocorrelation, R-hat and effective sample size against chains whose own are known."""

import numpy as np
import pytest

from memcomp_lightning import rng
from memcomp_lightning.trained.mixing import autocorrelation_time, effective_sample_size, split_r_hat

MOST_OFF = 0.3
"""Of a time of 19 steps the estimate is off by 3 % usually; by more, where its sum ends late."""


def normal(*shape, seed=0):
    return rng.numpy_stream(seed, "test chains").standard_normal(shape)


def autoregressive(phi, n_chains=64, n_draws=2000, seed=0):
    """Chains x' = phi x + noise of unit variance, whose integrated time is (1 + phi) / (1 - phi)."""
    noise = normal(n_chains, n_draws, 1, seed=seed)
    x = noise.copy()
    for t in range(1, n_draws):
        x[:, t] = phi * x[:, t - 1] + (1 - phi**2) ** 0.5 * noise[:, t]
    return x


@pytest.mark.parametrize("phi", [-0.6, 0.0, 0.5, 0.9])
def test_integrated_time_of_autoregressive_chains(phi):
    time = (1 + phi) / (1 - phi)
    x = autoregressive(phi)
    assert autocorrelation_time(x)[0] == pytest.approx(time, rel=MOST_OFF)
    assert effective_sample_size(x)[0] == pytest.approx(64 * 2000 / time, rel=MOST_OFF)


def test_r_hat_of_chains_that_mix_tells_their_length():
    for phi in (0.0, 0.9):
        time = (1 + phi) / (1 - phi)
        assert split_r_hat(autoregressive(phi))[0] ** 2 - 1 == pytest.approx(2 * (time - 1) / 2000, abs=0.003)


def test_each_statistic_stands_for_itself():
    x = np.concatenate([autoregressive(0.0), autoregressive(0.9, seed=1)], axis=-1)
    assert autocorrelation_time(x) == pytest.approx([1, 19], rel=MOST_OFF)
    np.testing.assert_array_equal(split_r_hat(x)[1:], split_r_hat(x[..., 1:]))


@pytest.mark.parametrize(
    ("change", "least"),
    [
        pytest.param(lambda x: x[:20].__iadd__(2.0), 1.2, id="means of some chains"),
        pytest.param(lambda x: x[:20].__imul__(4.0), 1.1, id="spread of some chains"),
        pytest.param(lambda x: x[:1].__iadd__(20.0), 1.5, id="one chain far away"),
        pytest.param(lambda x: x[:, 100:].__iadd__(1.0), 1.1, id="all chains moved half way"),
    ],
)
def test_r_hat_sees(change, least):
    x = normal(64, 200, 1)
    assert split_r_hat(x)[0] < 1.01
    change(x)
    assert split_r_hat(x)[0] > least


def test_r_hat_sees_shifts_of_heavy_tails():
    x = normal(64, 200, 1) / normal(64, 200, 1, seed=1)  # without a variance
    assert split_r_hat(x)[0] < 1.01
    x[:20] += 4
    assert split_r_hat(x)[0] > 1.1


def test_chains_that_stay_where_they_began_are_one_draw_each():
    x = 0.01 * normal(100, 500, 1) + normal(100, 1, 1, seed=1)
    assert 30 < effective_sample_size(x)[0] < 110


def test_rows_of_different_means_and_shapes_are_compared_within():
    two = np.stack([normal(32, 200, 1), 100 + np.sign(normal(32, 200, 1, seed=1))])
    assert split_r_hat(two)[0] < 1.01
    assert autocorrelation_time(two)[0] == pytest.approx(1, abs=0.05)
    two[0, :16] += 2
    assert split_r_hat(two)[0] > 1.1
    assert autocorrelation_time(two)[0] > 50


@pytest.mark.parametrize("level", [0.0, 0.1, 1e8])
def test_what_never_changes(level):
    same = np.full((4, 10, 1), level)
    assert split_r_hat(same)[0] == autocorrelation_time(same)[0] == 1
    different = same + np.arange(4.0).reshape(4, 1, 1)
    assert split_r_hat(different)[0] == np.inf
    assert autocorrelation_time(different)[0] == 19
