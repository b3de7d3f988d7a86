"""Controls that keep the distribution of pretrained weights and forget what was learned."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import DBN, GaussianMoments, Normal, Shuffled, with_batch_norm_relu


def dbn() -> DBN:
    made = DBN(7, [5, 3], replicas=(2,), weight_init=Normal(std=1.0))
    with torch.no_grad():
        for rbm in made:
            rbm.b.copy_(torch.arange(rbm.b.numel()).view_as(rbm.b))
            rbm.c.copy_(3 + torch.arange(rbm.c.numel()).view_as(rbm.c))
    return made


def test_shuffling_keeps_the_values_of_each_layer_and_replica_and_moves_them():
    before, after = dbn(), dbn()
    Shuffled()(after, generator=rng.stream(0, "shuffle"))
    for old, new in zip(before.parameters(), after.parameters(), strict=True):
        assert old.flatten(1).sort().values.equal(new.flatten(1).sort().values)
        assert not old.equal(new)
    first, second = after[0].weight
    orders = [
        (before[0].weight[k].flatten()[:, None] == w.flatten()).int().argmax(1)
        for k, w in ((0, first), (1, second))
    ]
    assert not orders[0].equal(orders[1])


def test_gaussian_has_the_moments_of_each_layer():
    big = DBN(101, [103], replicas=(2,), weight_init=Normal(std=1.0))
    with torch.no_grad():
        big[0].weight[0].uniform_(-1, 5, generator=rng.stream(0, "weights"))
        big[0].weight[1].uniform_(2, 3, generator=rng.stream(1, "weights"))
    mean, std = big[0].weight.flatten(1).mean(1), big[0].weight.flatten(1).std(1)
    GaussianMoments()(big, generator=rng.stream(0, "gaussian"))
    new = big[0].weight.detach().flatten(1)
    assert new.mean(1).tolist() == pytest.approx(mean.tolist(), abs=0.06)
    assert new.std(1).tolist() == pytest.approx(std.tolist(), rel=0.03)
    assert (new[0] > 6).any()  # beyond the uniform range: these are Gaussian
    assert big[0].b.abs().max() == 0


def test_batch_norm_and_relu_share_the_weights():
    network = dbn()
    hidden = with_batch_norm_relu(network)
    v = rng.uniform((2, 11, 7), generator=rng.stream(0, "v"))
    out = hidden(v)
    assert out.shape == (2, 11, 3)
    assert (out >= 0).all()
    out.sum().backward()
    assert network[0].weight.grad is not None
    x = v @ network[0].weight.mT + network[0].c.unsqueeze(-2)
    x = ((x - x.mean(-2, keepdim=True)) / (x.var(-2, correction=0, keepdim=True) + 1e-5).sqrt()).relu()
    x = x @ network[1].weight.mT + network[1].c.unsqueeze(-2)
    x = ((x - x.mean(-2, keepdim=True)) / (x.var(-2, correction=0, keepdim=True) + 1e-5).sqrt()).relu()
    torch.testing.assert_close(out, x, rtol=1e-4, atol=1e-5)
