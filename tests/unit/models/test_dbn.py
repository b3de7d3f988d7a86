"""The stack of RBMs."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, Normal


def dbn_with_biases(replicas=()):
    generator = rng.stream(0, "test model")
    dbn = DBN(11, [7, 5, 3], replicas=replicas, weight_init=Normal(std=0.8), generator=generator)
    with torch.no_grad():
        for rbm in dbn:
            rbm.b.normal_(0.3, 0.5, generator=generator)
            rbm.c.normal_(-0.2, 0.5, generator=generator)
    return dbn


def images(*shape):
    return rng.uniform(shape, generator=rng.stream(1, "test draws"))


@pytest.mark.parametrize("replicas", [(), (3,), (2, 3)], ids=str)
def test_layers_fit_together(replicas):
    dbn = DBN(11, [7, 5, 3], replicas=replicas)
    assert [(rbm.n_visible, rbm.n_hidden) for rbm in dbn] == [(11, 7), (7, 5), (5, 3)]
    assert (len(dbn), dbn.n_visible, dbn.n_hidden, dbn.replicas) == (3, 11, 3, replicas)
    assert dbn(images(*replicas, 13, 11)).shape == (*replicas, 13, 3)


def test_visible_of_applies_the_layers_below():
    dbn, v = dbn_with_biases(), images(13, 11)
    assert dbn.visible_of(0, v).equal(v)
    first = torch.sigmoid(v @ dbn[0].weight.mT + dbn[0].c)
    second = torch.sigmoid(first @ dbn[1].weight.mT + dbn[1].c)
    torch.testing.assert_close(dbn.visible_of(1, v), first)
    torch.testing.assert_close(dbn.visible_of(2, v), second)
    torch.testing.assert_close(dbn(v), torch.sigmoid(second @ dbn[2].weight.mT + dbn[2].c))


def test_images_of_projects_down_through_the_layers_below():
    dbn, x = dbn_with_biases(), images(13, 5)
    middle = torch.sigmoid(x @ dbn[1].weight + dbn[1].b)
    expected = torch.sigmoid(middle @ dbn[0].weight + dbn[0].b)
    projected = dbn.images_of(2, x)
    torch.testing.assert_close(projected, expected)
    assert not projected.requires_grad
    pixels = images(13, 11)
    assert dbn.images_of(0, pixels).equal(pixels)


def test_replicas_equal_single_networks():
    dbn, v = dbn_with_biases((3,)), images(3, 13, 11)
    one = DBN(11, [7, 5, 3])
    one.load_state_dict({name: tensor[1] for name, tensor in dbn.state_dict().items()})
    torch.testing.assert_close(dbn(v)[1], one(v[1]), rtol=1e-6, atol=1e-7)


def test_gradient_reaches_every_layer():
    dbn = dbn_with_biases()
    dbn(images(13, 11)).sum().backward()
    assert all(rbm.weight.grad.any() and rbm.c.grad.any() for rbm in dbn)


def test_error_names_number_of_layers():
    with pytest.raises(
        SettingError, match=r"^number of hidden layers = 0 is not allowed: expected an integer >= 1"
    ):
        DBN(11, [])


def test_error_names_size_of_an_empty_layer():
    with pytest.raises(SettingError, match=r"^n_hidden = 0 is not allowed"):
        DBN(11, [7, 0])
