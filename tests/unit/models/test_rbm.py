"""The RBM against explicit loops and enumeration."""

import itertools

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import RBM
from memcomp_lightning.objective import contrast
from memcomp_lightning.testing.conformance import small_rbm
from memcomp_lightning.types import Configurations

REPLICAS = [(), (3,), (2, 3)]
every_replica_shape = pytest.mark.parametrize("replicas", REPLICAS, ids=str)


def draw(*shape, seed=0):
    return rng.uniform(shape, generator=rng.stream(seed, "test draws")).double()


def bits(*shape, seed=0):
    return (draw(*shape, seed=seed) < 0.5).double()


def single(rbm, index):
    """The RBM at one index of the replica axes."""
    one = RBM(rbm.n_visible, rbm.n_hidden).double()
    with torch.no_grad():
        for name, parameter in one.named_parameters():
            parameter.copy_(getattr(rbm, name)[index])
    return one


@every_replica_shape
def test_shapes(replicas):
    rbm = small_rbm(replicas=replicas).double()
    v, h = draw(*replicas, 11, 7), draw(*replicas, 11, 5, seed=1)
    assert (rbm.n_visible, rbm.n_hidden, rbm.replicas) == (7, 5, replicas)
    assert rbm.weight.shape == (*replicas, 5, 7)
    for energy in (rbm.energy(v, h), rbm.free_energy(v), rbm.hidden_free_energy(h)):
        assert energy.shape == (*replicas, 11)
    for hidden in (rbm.hidden_field(v), rbm.hidden_mean(v), rbm(v)):
        assert hidden.shape == (*replicas, 11, 5)
    for visible in (rbm.visible_field(h), rbm.visible_mean(h)):
        assert visible.shape == (*replicas, 11, 7)
    assert rbm.mean_energy(Configurations(v, h)).shape == replicas


def test_biases_start_at_zero():
    rbm = RBM(7, 5, replicas=(3,))
    assert not rbm.b.any()
    assert not rbm.c.any()
    assert rbm.weight.any()


def test_energy_is_the_sum_of_equation_3():
    rbm = small_rbm().double()
    v, h = draw(11, 7), draw(11, 5, seed=1)
    w, b, c = rbm.weight.tolist(), rbm.b.tolist(), rbm.c.tolist()
    expected = [
        -sum(w[i][j] * h[n, i].item() * v[n, j].item() for i in range(5) for j in range(7))
        - sum(b[j] * v[n, j].item() for j in range(7))
        - sum(c[i] * h[n, i].item() for i in range(5))
        for n in range(11)
    ]
    torch.testing.assert_close(rbm.energy(v, h), torch.tensor(expected, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("beta", [1.0, 0.7])
def test_hidden_mean_follows_from_energy_differences(beta):
    rbm = small_rbm().double()
    v, h = bits(11, 7), bits(11, 5, seed=1)
    for i in range(5):
        on, off = h.clone(), h.clone()
        on[:, i], off[:, i] = 1, 0
        odds = torch.exp(-beta * (rbm.energy(v, on) - rbm.energy(v, off)))
        torch.testing.assert_close(rbm.hidden_mean(v, beta=beta)[:, i], odds / (1 + odds))


@pytest.mark.parametrize("beta", [1.0, 0.7])
def test_visible_mean_follows_from_energy_differences(beta):
    rbm = small_rbm().double()
    v, h = bits(11, 7), bits(11, 5, seed=1)
    for j in range(7):
        on, off = v.clone(), v.clone()
        on[:, j], off[:, j] = 1, 0
        odds = torch.exp(-beta * (rbm.energy(on, h) - rbm.energy(off, h)))
        torch.testing.assert_close(rbm.visible_mean(h, beta=beta)[:, j], odds / (1 + odds))


@every_replica_shape
def test_free_energy_sums_the_hidden_states_out(replicas):
    rbm = small_rbm(replicas=replicas).double()
    v = draw(*replicas, 11, 7)
    states = binary_states(5, like=v).expand(*replicas, 32, 5)
    energies = torch.stack([rbm.energy(v, states[..., s : s + 1, :].expand(*replicas, 11, 5)) for s in range(32)])
    torch.testing.assert_close(rbm.free_energy(v), -torch.logsumexp(-energies, 0))


@every_replica_shape
def test_hidden_free_energy_sums_the_visible_states_out(replicas):
    rbm = small_rbm(replicas=replicas).double()
    h = draw(*replicas, 11, 5)
    states = binary_states(7, like=h).expand(*replicas, 128, 7)
    energies = torch.stack([rbm.energy(states[..., s : s + 1, :].expand(*replicas, 11, 7), h) for s in range(128)])
    torch.testing.assert_close(rbm.hidden_free_energy(h), -torch.logsumexp(-energies, 0))


@every_replica_shape
@pytest.mark.parametrize("weighted", [False, True])
def test_mean_energy_is_the_weighted_mean_of_the_energy(replicas, weighted):
    rbm = small_rbm(replicas=replicas).double()
    v, h = draw(*replicas, 11, 7), draw(*replicas, 11, 5, seed=1)
    weight = 3 * draw(*replicas, 11, seed=2) if weighted else torch.ones(*replicas, 11).double()
    expected = (rbm.energy(v, h) * weight).sum(-1) / weight.sum(-1)
    given = Configurations(v, h, weight if weighted else None)
    torch.testing.assert_close(rbm.mean_energy(given), expected)


@every_replica_shape
def test_total_energy_takes_weights_of_either_sign(replicas):
    rbm = small_rbm(replicas=replicas).double()
    v, h = draw(*replicas, 11, 7), draw(*replicas, 11, 5, seed=1)
    weight = 2 * draw(*replicas, 11, seed=2) - 1
    torch.testing.assert_close(rbm.total_energy(v, h, weight), (rbm.energy(v, h) * weight).sum(-1))


@every_replica_shape
@pytest.mark.parametrize("weighted", [False, True])
def test_contrast_is_the_difference_of_the_mean_energies(replicas, weighted):
    rbm = small_rbm(replicas=replicas).double()
    positive = Configurations(draw(*replicas, 11, 7), draw(*replicas, 11, 5, seed=1))
    weight = 3 * draw(*replicas, 13, seed=4) if weighted else None
    negative = Configurations(draw(*replicas, 13, 7, seed=2), draw(*replicas, 13, 5, seed=3), weight)
    share = torch.ones(*replicas, 13).double() if weight is None else weight
    expected = rbm.energy(positive.v, positive.h).mean(-1)
    expected = expected - (rbm.energy(negative.v, negative.h) * share).sum(-1) / share.sum(-1)
    torch.testing.assert_close(contrast(rbm, positive, negative), expected)


def test_gradient_of_the_mean_energy_is_that_of_the_mean_of_the_energy():
    rbm = small_rbm(replicas=(3,)).double()
    v, h, weight = draw(3, 11, 7), draw(3, 11, 5, seed=1), draw(3, 11, seed=2)
    share = weight / weight.sum(-1, keepdim=True)
    parameters = list(rbm.parameters())
    fast = torch.autograd.grad(rbm.mean_energy(Configurations(v, h, weight)).sum(), parameters)
    slow = torch.autograd.grad((rbm.energy(v, h) * share).sum(), parameters)
    for a, b in zip(fast, slow, strict=True):
        torch.testing.assert_close(a, b)


def test_both_phases_are_constants_to_autograd():
    rbm = small_rbm().double()
    v = draw(11, 7).requires_grad_()
    h = draw(11, 5, seed=1).requires_grad_()
    rbm.mean_energy(Configurations(v, h)).backward()
    assert v.grad is None
    assert h.grad is None
    assert rbm.weight.grad is not None


@pytest.mark.parametrize("replicas", REPLICAS[1:], ids=str)
def test_replicas_equal_single_models(replicas):
    rbm = small_rbm(replicas=replicas).double()
    v, h = draw(*replicas, 11, 7), draw(*replicas, 11, 5, seed=1)
    weight = draw(*replicas, 11, seed=2)
    close = {"rtol": 1e-14, "atol": 1e-14}
    for index in itertools.product(*map(range, replicas)):
        one = single(rbm, index)
        torch.testing.assert_close(rbm.energy(v, h)[index], one.energy(v[index], h[index]), **close)
        torch.testing.assert_close(rbm.free_energy(v)[index], one.free_energy(v[index]), **close)
        torch.testing.assert_close(rbm.hidden_free_energy(h)[index], one.hidden_free_energy(h[index]), **close)
        torch.testing.assert_close(rbm(v)[index], one(v[index]), **close)
        torch.testing.assert_close(rbm.visible_mean(h)[index], one.visible_mean(h[index]), **close)
        torch.testing.assert_close(
            rbm.mean_energy(Configurations(v, h, weight))[index],
            one.mean_energy(Configurations(v[index], h[index], weight[index])),
            **close,
        )


def test_replicas_start_apart():
    weight = RBM(7, 5, replicas=(3,)).weight
    assert not weight[0].equal(weight[1])


def test_same_generator_gives_the_same_weights_and_another_one_others():
    weights = [RBM(7, 5, generator=rng.stream(seed, "weights")).weight for seed in (0, 0, 1)]
    assert weights[0].equal(weights[1])
    assert not weights[0].equal(weights[2])
    assert weights[0].equal(RBM(7, 5).weight)


@pytest.mark.parametrize(("n_visible", "n_hidden", "name"), [(0, 5, "n_visible"), (7, -2, "n_hidden")])
def test_error_names_size_value_and_allowed(n_visible, n_hidden, name):
    value = min(n_visible, n_hidden)
    with pytest.raises(SettingError, match=f"^{name} = {value} is not allowed: expected an integer >= 1"):
        RBM(n_visible, n_hidden)


def test_binary_states_count_in_binary():
    states = binary_states(5, like=torch.zeros((), dtype=torch.float64))
    assert states.dtype == torch.float64
    assert (states @ torch.tensor([16.0, 8, 4, 2, 1]).double()).tolist() == list(range(32))
    assert binary_states(5, start=3, stop=17, like=states).equal(states[3:17])
    assert binary_states(0, like=states).shape == (1, 0)
