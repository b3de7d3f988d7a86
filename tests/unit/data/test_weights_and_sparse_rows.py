"""Batches of weighted images, and of images in sparse rows."""

import pytest
import torch
from torch import nn

from memcomp_lightning import rng
from memcomp_lightning.data import Batches, SparseRows
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, RBM, BoltzmannMachine, Linear, Normal
from memcomp_lightning.objective import contrast, weighted
from memcomp_lightning.samplers import CD, ExactPosterior, MeanField, positive_phase
from memcomp_lightning.training import LOSSES, ClassifierStep
from memcomp_lightning.types import Batch, Configurations, NoState


def images(n=7, n_visible=5):
    return rng.uniform((n, n_visible), generator=rng.stream(0, "images")).double().round()


def rows_of(v):
    sparse = v.to_sparse_coo().coalesce()
    counts = torch.bincount(sparse.indices()[0], minlength=len(v))
    start = torch.cat((torch.zeros(1, dtype=torch.long), counts.cumsum(0)))
    return SparseRows(start, sparse.indices()[1], sparse.values(), v.shape[1])


@pytest.mark.parametrize("batch_size", [None, 3])
def test_batches_of_sparse_rows_are_those_of_the_dense_images(batch_size):
    v, label = images(), torch.arange(7)
    settings = {"batch_size": batch_size, "chunk_size": 2, "shuffle": True, "seed": 0}
    dense, sparse = Batches(v, label, **settings), Batches(rows_of(v), label, **settings).to("cpu")
    for a, b in zip(dense, sparse, strict=True):
        assert torch.equal(a.v, b.v)
        assert torch.equal(a.label, b.label)
        assert (a.share, a.closes_step) == (b.share, b.closes_step)
    with pytest.raises(ValueError, match="replica axis"):
        sparse.repeated([0, 1])


def test_an_empty_row_is_a_row_of_zeros():
    v = torch.tensor([[0.0, 0.0], [0.0, 2.0], [0.0, 0.0]])
    assert torch.equal(rows_of(v).dense(torch.tensor([2, 1, 0, 1])), v[[2, 1, 0, 1]])


@pytest.mark.parametrize("world_size", [1, 2])
@pytest.mark.parametrize("chunk_size", [1, 2, 10])
def test_shares_add_up_to_the_weighted_mean_of_a_step(chunk_size, world_size):
    v, weight = images(6), torch.tensor([1.0, 2.0, 0.5, 4.0, 1.0, 3.0], dtype=torch.float64)
    label = torch.arange(6)
    if chunk_size == 1 and world_size == 2:
        pytest.skip("uneven steps")
    total, seen = torch.zeros(5, dtype=torch.float64), []
    for rank in range(world_size):
        batches = Batches(v, label, None, chunk_size, True, 0, rank, world_size, weight)
        for batch in batches:
            total += batch.share * (batch.weight.unsqueeze(-1) * batch.v).sum(0) / batch.weight.sum() / world_size
            assert torch.equal(batch.weight, weight[batch.label])
            seen += batch.label.tolist()
    assert sorted(seen) == list(range(6))
    torch.testing.assert_close(total, (weight.unsqueeze(-1) * v).sum(0) / weight.sum())


@pytest.mark.parametrize(("batch_size", "chunk_size"), [(None, 9), (3, 9), (3, 2)])
def test_weights_go_with_their_images_in_the_order_of_each_seed(batch_size, chunk_size):
    weight, label = torch.tensor([1.0, 2.0, 0.5, 4.0, 1.0, 3.0]), torch.arange(6)
    batches = [Batches(images(6), label, batch_size, chunk_size, True, seed, weight=weight) for seed in (0, 4)]
    seeds = [4] if chunk_size == 2 else [0, 4]
    for alone, together in zip(batches[1], batches[0].repeated(seeds), strict=True):
        assert together.weight.equal(weight[together.label])
        assert together.weight[-1].equal(alone.weight)
        assert together.share == pytest.approx(alone.share)
    if chunk_size == 2:
        with pytest.raises(SettingError, match="one seed for images with weights"):
            batches[0].repeated([0, 4])


@pytest.mark.parametrize(
    ("weight", "message"), [(torch.ones(3), "weight.shape"), (torch.tensor([1.0, 0.0]), "weight = 0.0")]
)
def test_weights_that_do_not_fit_are_refused(weight, message):
    with pytest.raises(SettingError, match=message):
        Batches(torch.ones(2, 3), torch.zeros(2).long(), None, 2, False, 0, weight=weight)


def gradients(model, value):
    model.zero_grad()
    value.backward()
    return [parameter.grad.clone() for parameter in model.parameters()]


@pytest.mark.parametrize("with_posterior", [False, True])
def test_the_contrast_takes_a_weight_as_repeats(with_posterior):
    """One configuration an image, and several that carry weights of their own."""
    v, weight = images(3, 4), torch.tensor([1.0, 3.0, 2.0], dtype=torch.float64)
    repeated = v.repeat_interleave(weight.long(), dim=0)
    model = DBN(4, [3], weight_init=Normal(std=1.0)).double()[0]
    nothing = Configurations(torch.zeros(1, 4).double(), torch.zeros(1, 3).double())

    def phase(of):
        if with_posterior:
            return ExactPosterior().sample(model, of, generator=rng.stream(0, "x")).configurations
        return positive_phase(model, of)

    a = gradients(model, contrast(model, weighted(phase(v), weight), nothing))
    b = gradients(model, contrast(model, phase(repeated), nothing))
    torch.testing.assert_close(a, b)
    assert not all(
        x.equal(y) for x, y in zip(a, gradients(model, contrast(model, phase(v), nothing)), strict=True)
    )


def test_a_reconstruction_weighs_what_its_image_does():
    weight = torch.tensor([1.0, 3.0, 2.0])
    layer, machine = RBM(4, 3), BoltzmannMachine(4, 3)
    of_layer = positive_phase(layer, images(3, 4).float())
    of_machine = MeanField().sample(machine, images(3, 4).float(), generator=rng.stream(0, "x")).configurations
    for model, positive in ((layer, of_layer), (machine, of_machine)):
        phase = CD().sample(model, NoState(), weighted(positive, weight), generator=rng.stream(0, "negative"))
        assert torch.equal(phase.configurations.weight, weight)


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
@pytest.mark.parametrize("closed_form", [True, False])
def test_the_loss_takes_a_weight_as_repeats(closed_form, loss):
    v, label = images(3, 4), torch.tensor([0, 2, 1])
    weight = torch.tensor([1.0, 3.0, 2.0], dtype=torch.float64)
    hidden = DBN(4, [5], weight_init=Normal(std=1.0)).double()
    network = nn.Sequential(hidden, *([] if closed_form else [nn.Identity()]), Linear(5, 3).double())

    def gradient(batch):
        network.zero_grad()
        ClassifierStep(network, loss).add_gradient(batch)
        return [p.grad.clone() for p in network.parameters() if p.grad is not None]

    repeats = weight.long()
    repeated = Batch(v.repeat_interleave(repeats, 0), label.repeat_interleave(repeats), 0.5, True)
    weighted_gradient = gradient(Batch(v, label, 0.5, True, weight))
    torch.testing.assert_close(weighted_gradient, gradient(repeated))
    assert not torch.allclose(weighted_gradient[0], gradient(Batch(v, label, 0.5, True))[0])
