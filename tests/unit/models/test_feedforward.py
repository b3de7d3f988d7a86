"""Feed-forward layers against torch's own, replica by replica."""

import copy

import pytest
import torch
from torch import nn

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import BatchNorm, BatchNormReluNetwork, Linear, Normal


def inputs(*shape, seed=0):
    return 3 * rng.uniform(shape, generator=rng.stream(seed, "test draws")) - 1


@pytest.mark.parametrize("momentum", [0.1, 0.7])
def test_batch_norm_equals_torch_for_each_replica(momentum):
    ours = BatchNorm(5, replicas=(2, 3), momentum=momentum)
    with torch.no_grad():
        ours.weight.copy_(inputs(2, 3, 5, seed=1))
        ours.bias.copy_(inputs(2, 3, 5, seed=2))
    theirs = {}
    for index in ((i, j) for i in range(2) for j in range(3)):
        theirs[index] = nn.BatchNorm1d(5, momentum=momentum)
        theirs[index].weight.data.copy_(ours.weight[index])
        theirs[index].bias.data.copy_(ours.bias[index])
    scale = torch.arange(1.0, 7.0).view(2, 3, 1, 1)
    for batch in range(3):
        x = scale * inputs(2, 3, 11, 5, seed=3 + batch) + scale
        out = ours(x)
        for index, layer in theirs.items():
            torch.testing.assert_close(out[index], layer(x[index]))
            torch.testing.assert_close(ours.running_mean[index], layer.running_mean)
            torch.testing.assert_close(ours.running_var[index], layer.running_var)
    ours.eval()
    x = inputs(2, 3, 13, 5, seed=7)
    before = copy.deepcopy(ours.state_dict())
    out = ours(x)
    for index, layer in theirs.items():
        torch.testing.assert_close(out[index], layer.eval()(x[index]))
    assert all(before[name].equal(tensor) for name, tensor in ours.state_dict().items())


def test_batch_norm_without_replicas_equals_torch():
    x = inputs(11, 5)
    torch.testing.assert_close(BatchNorm(5)(x), nn.BatchNorm1d(5)(x))


@pytest.mark.parametrize("replicas", [(), (3,), (2, 3)], ids=str)
def test_linear_is_a_matrix_product_and_a_bias(replicas):
    layer = Linear(7, 5, replicas=replicas, weight_init=Normal(std=1.0))
    with torch.no_grad():
        layer.bias.copy_(inputs(*replicas, 5, seed=1))
    x = inputs(*replicas, 11, 7)
    expected = torch.einsum("...nj,...ij->...ni", x, layer.weight) + layer.bias.unsqueeze(-2)
    torch.testing.assert_close(layer(x), expected)


def test_network_equals_torch_layers():
    ours = BatchNormReluNetwork(7, [5, 3], 2, weight_init=Normal(std=1.0))
    theirs = nn.Sequential()
    for layer in ours.layers:
        if isinstance(layer, Linear):
            copied = nn.utils.skip_init(nn.Linear, layer.weight.shape[1], layer.weight.shape[0])
            copied.weight.data, copied.bias.data = layer.weight.data, layer.bias.data
            theirs.append(copied)
        else:
            theirs.append(nn.BatchNorm1d(layer.weight.shape[0]) if isinstance(layer, BatchNorm) else nn.ReLU())
    assert len(ours.layers) == 7
    x = inputs(11, 7)
    torch.testing.assert_close(ours(x), theirs(x))


def test_network_replicas_equal_single_networks():
    ours = BatchNormReluNetwork(7, [5, 3], 2, replicas=(3,), weight_init=Normal(std=1.0))
    one = BatchNormReluNetwork(7, [5, 3], 2)
    one.load_state_dict({name: tensor[1] for name, tensor in ours.state_dict().items()})
    x = inputs(3, 11, 7)
    torch.testing.assert_close(ours(x)[1], one(x[1]))


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Linear(0, 5), "n_in = 0 is not allowed: expected an integer >= 1"),
        (lambda: Linear(7, 0), "n_out = 0 is not allowed: expected an integer >= 1"),
        (lambda: BatchNorm(0), "n_features = 0 is not allowed: expected an integer >= 1"),
        (lambda: BatchNormReluNetwork(7, [], 2), "number of hidden layers = 0 is not allowed"),
        (lambda: BatchNormReluNetwork(7, [5], 1), "n_classes = 1 is not allowed: expected an integer >= 2"),
    ],
)
def test_error_names_setting_value_and_allowed(build, message):
    with pytest.raises(SettingError, match=f"^{message}"):
        build()
