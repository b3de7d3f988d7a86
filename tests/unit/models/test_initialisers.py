"""What initial weights are drawn from."""

import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, RBM, Linear, Normal, Uniform, Xavier

N = 101 * 103


def draw(initialiser, shape=(101, 103)):
    return initialiser(shape, generator=rng.stream(0, "weights"))


def test_gaussian_has_mean_zero_and_its_deviation():
    w = draw(Normal(std=0.3))
    assert abs(w.mean()) < 5 * 0.3 / math.sqrt(N)
    assert abs(w.std() - 0.3) < 5 * 0.3 / math.sqrt(2 * N)
    assert ((w.abs() < 0.3).float().mean() - 0.6827).abs() < 5 * 0.47 / math.sqrt(N)


def test_uniform_fills_its_interval():
    w = draw(Uniform(low=-0.2, high=0.7))
    assert w.min() >= -0.2
    assert w.max() < 0.7
    assert w.min() < -0.199
    assert w.max() > 0.699
    assert abs(w.mean() - 0.25) < 5 * 0.9 / math.sqrt(12 * N)


@pytest.mark.parametrize("gain", [1.0, 0.3])
def test_xavier_bound_counts_inputs_and_outputs(gain):
    w = draw(Xavier(gain=gain), shape=(7, 83, 23))
    bound = gain * math.sqrt(6 / (83 + 23))
    assert w.abs().max() <= bound
    assert w.abs().max() > 0.999 * bound
    assert abs(w.var() - bound**2 / 3) < 0.05 * bound**2 / 3


@pytest.mark.parametrize("initialiser", [Normal(), Uniform(low=-1, high=1), Xavier()], ids=repr)
@pytest.mark.parametrize("replicas", [(), (3,), (2, 3)], ids=str)
def test_shape_and_stream(initialiser, replicas):
    first, again = draw(initialiser, (*replicas, 5, 7)), draw(initialiser, (*replicas, 5, 7))
    assert first.shape == (*replicas, 5, 7)
    assert first.equal(again)
    assert not first.equal(initialiser((*replicas, 5, 7), generator=rng.stream(1, "weights")))


@pytest.mark.parametrize(
    "build",
    [
        lambda init: RBM(7, 5, weight_init=init).weight,
        lambda init: Linear(7, 5, weight_init=init).weight,
        lambda init: DBN(7, [5, 3], weight_init=init)[1].weight,
    ],
)
def test_models_use_their_initialiser(build):
    assert (build(Uniform(low=2.0, high=3.0)) >= 2).all()
    default = build(None)
    assert default.abs().max() < 0.05
    assert default.any()


def test_standard_deviation_zero_is_allowed():
    assert not draw(Normal(std=0.0)).any()
    assert torch.equal(draw(Uniform(low=1.0, high=1.0)), torch.ones(101, 103))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Normal(std=-0.1), r"std = -0.1 is not allowed: expected a number >= 0"),
        (lambda: Normal(std=math.nan), r"std = nan is not allowed: expected a number >= 0"),
        (lambda: Uniform(low=1.0, high=0.5), r"low = 1.0 is not allowed: expected a number <= high = 0.5"),
        (lambda: Xavier(gain=0.0), r"gain = 0.0 is not allowed: expected a number > 0"),
    ],
)
def test_error_names_setting_value_and_allowed(build, message):
    with pytest.raises(SettingError, match=f"^{message}"):
        build()
