"""The gradient of the contrast is the gradient of the enumerated log-likelihood."""

import copy
from types import SimpleNamespace

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.objective import Centring, Offsets, contrast
from memcomp_lightning.samplers import CD, Exact, positive_phase
from memcomp_lightning.testing.conformance import small_rbm
from memcomp_lightning.types import Configurations, NoState

SIZES = [(7, 5), (5, 7)]
REPLICAS = [(), (3,), (2, 3)]


def data(rbm, binary, n=11):
    v = rng.uniform((*rbm.replicas, n, rbm.n_visible), generator=rng.stream(1, "data")).double()
    return (v < 0.4).double() if binary else v


def negative_log_likelihood(rbm, v):
    """Mean over the images of ``log Z - log sum_h exp(-E(v, h))``, from energies alone."""
    n_visible, n_hidden = rbm.n_visible, rbm.n_hidden
    joint = binary_states(n_visible + n_hidden, like=v)
    weight, b, c = rbm.weight, rbm.b, rbm.c
    x, h = joint[:, :n_visible], joint[:, n_visible:]
    energy = -torch.einsum("...ij,si,sj->...s", weight, h, x) - b @ x.T - c @ h.T
    log_z = torch.logsumexp(-energy, -1)
    hidden = binary_states(n_hidden, like=v)
    clamped = torch.einsum("...ij,si,...nj->...ns", weight, hidden, v)
    clamped = clamped + (v @ b.unsqueeze(-1)) + (c @ hidden.T).unsqueeze(-2)
    return log_z - torch.logsumexp(clamped, -1).mean(-1)


def gradients(rbm, sampler, v):
    state = sampler.init(rbm, v.shape[-2], generator=rng.stream(0, "negative_phase"))
    positive = positive_phase(rbm, v)
    negative = sampler.sample(rbm, state, positive, generator=rng.stream(0, "negative_phase"))
    ours = torch.autograd.grad(contrast(rbm, positive, negative.configurations).sum(), list(rbm.parameters()))
    true = torch.autograd.grad(negative_log_likelihood(rbm, v).sum(), list(rbm.parameters()))
    return ours, true


@pytest.mark.parametrize("sizes", SIZES, ids=str)
@pytest.mark.parametrize("replicas", REPLICAS, ids=str)
@pytest.mark.parametrize("binary", [True, False], ids=["binary", "real-valued"])
def test_contrast_with_exact_negative_phase_is_the_likelihood_gradient(sizes, replicas, binary):
    rbm = small_rbm(*sizes, replicas=replicas).double()
    for ours, true in zip(*gradients(rbm, Exact(), data(rbm, binary)), strict=True):
        assert true.abs().min() > 1e-6
        torch.testing.assert_close(ours, true, rtol=0, atol=1e-13)


def test_contrast_with_one_sweep_is_not_the_likelihood_gradient():
    rbm = small_rbm().double()
    ours, true = gradients(rbm, CD(k=1), data(rbm, binary=True))
    assert (ours[0] - true[0]).abs().max() > 1e-3


@pytest.mark.parametrize("k", [1, 2])
def test_last_half_sweep_of_cd_keeps_what_it_is_told(k):
    """The draw of a unit follows its mean: both are had from one random stream."""
    rbm = small_rbm().double()
    positive = positive_phase(rbm, data(rbm, binary=True))

    def sample(generator, **readouts):
        return CD(k=k, **readouts).sample(rbm, NoState(), positive, generator=generator).configurations

    generator = rng.stream(0, "negative_phase")
    means = sample(generator, visible="mean")
    assert ((means.v > 0) & (means.v < 1)).all()
    torch.testing.assert_close(means.h, rbm.hidden_mean(means.v))
    drawn = rng.bernoulli(means.v, generator=generator)
    usual = sample(rng.stream(0, "negative_phase"))
    assert usual.v.equal(drawn)
    assert usual.h.equal(rbm.hidden_mean(drawn))
    generator = rng.stream(0, "negative_phase")
    sampled = sample(generator, hidden="sample")
    assert sampled.v.equal(usual.v)
    assert ((sampled.h == 0) | (sampled.h == 1)).all()
    assert not sampled.h.equal(rng.bernoulli(usual.h, generator=generator))
    with pytest.raises(SettingError, match="visible = 'median'"):
        CD(visible="median")


def test_contrast_changes_by_the_likelihood_ratio_to_first_order():
    rbm = small_rbm().double()
    v = data(rbm, binary=True)
    ours, _ = gradients(rbm, Exact(), v)
    before = negative_log_likelihood(rbm, v)
    step = 1e-6
    with torch.no_grad():
        for parameter, gradient in zip(rbm.parameters(), ours, strict=True):
            parameter -= step * gradient
    fall = sum(gradient.square().sum() for gradient in ours) * step
    torch.testing.assert_close(before - negative_log_likelihood(rbm, v), fall, rtol=1e-4, atol=0)


def test_replicas_stay_independent():
    rbm = small_rbm(replicas=(3,)).double()
    v = data(rbm, binary=True)
    ours, _ = gradients(rbm, Exact(), v)
    v[2] = 1 - v[2]
    other, _ = gradients(rbm, Exact(), v)
    for a, b in zip(ours, other, strict=True):
        assert a[:2].equal(b[:2])
        assert not a[2].equal(b[2])


def centred_loss(rbm, parameters, offsets, v):
    """Mean negative log-likelihood of the RBM whose centred parameters are given, by enumeration."""
    weight, b, c = parameters
    mu, lam = offsets
    plain = SimpleNamespace(
        weight=weight,
        b=b - (lam.unsqueeze(-2) @ weight).squeeze(-2),
        c=c - (weight @ mu.unsqueeze(-1)).squeeze(-1),
        n_visible=rbm.n_visible,
        n_hidden=rbm.n_hidden,
    )
    return negative_log_likelihood(plain, v)


@pytest.mark.parametrize("replicas", REPLICAS, ids=str)
def test_centred_gradient_is_a_step_of_the_centred_parametrisation(replicas):
    """A small step along it is the step that descent on the centred parameters makes, seen in W, b and c."""
    rbm, v = small_rbm(7, 5, replicas=replicas).double(), data(small_rbm(7, 5, replicas=replicas), binary=True)
    positive = positive_phase(rbm, v)
    offsets = Centring().follow(None, positive)
    torch.testing.assert_close(offsets.visible, v.mean(-2))
    negative = Exact().sample(rbm, NoState(), positive, generator=rng.stream(0, "unused")).configurations
    loss = contrast(rbm, positive, negative, offsets)
    torch.testing.assert_close(loss, contrast(rbm, positive, negative))
    ours = torch.autograd.grad(loss.sum(), [rbm.weight, rbm.b, rbm.c])
    mu, lam = offsets
    with torch.no_grad():
        centred = [
            rbm.weight.clone(),
            rbm.b + (lam.unsqueeze(-2) @ rbm.weight).squeeze(-2),
            rbm.c + (rbm.weight @ mu.unsqueeze(-1)).squeeze(-1),
        ]
    centred = [x.requires_grad_() for x in centred]
    g_weight, g_b, g_c = torch.autograd.grad(centred_loss(rbm, centred, offsets, v).sum(), centred)
    expected = [
        g_weight,
        g_b - (lam.unsqueeze(-2) @ g_weight).squeeze(-2),
        g_c - (g_weight @ mu.unsqueeze(-1)).squeeze(-1),
    ]
    for a, e in zip(ours, expected, strict=True):
        torch.testing.assert_close(a, e, rtol=0, atol=1e-12)


def test_centred_gradient_does_not_care_which_state_is_called_one():
    """Flipping visible unit 2 flips its weights' gradient and nothing else."""
    rbm, v = small_rbm(7, 5).double(), data(small_rbm(7, 5), binary=True)

    def gradient(model, images):
        positive = positive_phase(model, images)
        negative = Exact().sample(model, NoState(), positive, generator=rng.stream(0, "unused")).configurations
        loss = contrast(model, positive, negative, Centring().follow(None, positive))
        return torch.autograd.grad(loss, model.weight)[0]

    flipped, other = copy.deepcopy(rbm), v.clone()
    other[:, 2] = 1 - other[:, 2]
    with torch.no_grad():
        flipped.c += flipped.weight[:, 2]
        flipped.weight[:, 2] *= -1
        flipped.b[2] *= -1
    expected = gradient(rbm, v)
    expected[:, 2] *= -1
    torch.testing.assert_close(gradient(flipped, other), expected, rtol=0, atol=1e-12)


def test_offsets_follow_the_positive_phase():
    old = Offsets(torch.zeros(2), torch.ones(3))
    positive = Configurations(torch.tensor([[1.0, 0.0], [1.0, 1.0]]), torch.zeros(2, 3))
    new = Centring(rate=0.25).follow(old, positive)
    assert new.visible.tolist() == [0.25, 0.125]
    assert new.hidden.tolist() == [0.75] * 3
    with pytest.raises(SettingError, match="centring rate = 0"):
        Centring(rate=0)
