"""Likelihoods of Boltzmann machines and DBMs against all states."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import (
    Ais,
    ReverseAis,
    base_of,
    base_on_first_class,
    kl_divergence,
    log_likelihood,
    log_likelihood_bound,
    log_partition_function,
)
from memcomp_lightning.models import DBM, BoltzmannMachine, as_two_layers
from memcomp_lightning.models.connectivity import grid
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import CD, Exact, ExactPosterior, GroundState, MeanField
from memcomp_lightning.solvers import BruteForce
from memcomp_lightning.testing import small_dbm, small_machine
from memcomp_lightning.testing.conformance import _with_biases


def small_grid(*, replicas=()):
    return _with_biases(BoltzmannMachine(6, 2, grid(2, 4), replicas=replicas), rng.stream(0, "biases"))


def visible_only(*, replicas=()):
    return _with_biases(BoltzmannMachine(5, 0, replicas=replicas), rng.stream(0, "biases"))


MODELS = pytest.mark.parametrize("make", [small_dbm, small_machine, small_grid, visible_only])


def log_joint(model):
    """-E of all states, ``(*replicas, 2^n_visible, 2^n_hidden)``."""
    x = binary_states(model.n_units, like=model.b)
    x = x.expand(*model.replicas, *x.shape)
    energy = model.energy(x[..., : model.n_visible], x[..., model.n_visible :])
    return -energy.detach().unflatten(-1, (2**model.n_visible, -1))


@MODELS
@pytest.mark.parametrize("replicas", [(), (2,), (2, 3)], ids=str)
def test_log_z_and_likelihoods_are_those_of_all_states(make, replicas):
    model = make(replicas=replicas)
    true = log_joint(model.double())
    model.float()
    log_z = log_partition_function(model)
    torch.testing.assert_close(log_z, true.logsumexp((-2, -1)), rtol=1e-6, atol=1e-6)
    v = binary_states(model.n_visible, like=model.b)
    torch.testing.assert_close(
        log_likelihood(model, v, log_z), true.logsumexp(-1) - log_z.unsqueeze(-1), rtol=1e-6, atol=1e-5
    )
    rows = v[[1, 1, 7]]
    log_p = log_likelihood(model, rows, log_z)
    share = torch.tensor([2 / 3, 2 / 3, 1 / 3]).double()
    torch.testing.assert_close(kl_divergence(model, rows), (share.log() - log_p).mean(-1))


@MODELS
def test_the_bound_lies_below_and_is_tight_without_couplings_between_hidden_units(make):
    model = make(replicas=(2,)).double()
    v, log_z = binary_states(model.n_visible, like=model.b), log_partition_function(model)
    gap = log_likelihood(model, v, log_z) - log_likelihood_bound(model, v, log_z, tolerance=1e-10)
    assert bool((gap > -1e-9).all())
    coupled = make in (small_dbm, small_machine)
    assert (float(gap.max()) > 1e-4) == coupled


def test_a_dbm_is_folded_into_an_rbm_of_its_odd_and_even_layers():
    dbm = small_dbm(replicas=(2,)).double()
    rbm = as_two_layers(dbm).rbm
    assert (rbm.n_visible, rbm.n_hidden) == (5 + 2, 3)
    x = binary_states(dbm.n_units, like=dbm.b).expand(2, -1, -1)
    first, second = (x[..., units] for units in dbm.classes)
    torch.testing.assert_close(rbm.energy(first, second), dbm.energy(x[..., :5], x[..., 5:]))
    with pytest.raises(SettingError, match="number of classes of units = 7"):
        as_two_layers(BoltzmannMachine(4, 3))


def test_annealing_of_a_dbm_finds_log_z_from_both_sides():
    dbm = small_dbm(replicas=(2,)).double()
    v = (binary_states(5, like=dbm.b) * 0.9).round()
    base, true = base_of(v), log_partition_function(dbm)
    up = Ais(n_chains=200, n_betas=300).estimate(dbm, generator=rng.stream(0, "ais"), base=base)
    assert bool(((up.log_z - true).abs() < 4 * up.standard_error + 1e-3).all())
    generator = rng.stream(0, "samples")
    x = torch.cat(log_samples(dbm, 200, generator), dim=-1)
    settings, state = ReverseAis(n_betas=300), generator.get_state()
    down = settings.estimate(dbm, x, generator=generator, base=base)
    assert bool(((down.log_z - true).abs() < 4 * down.standard_error + 1e-3).all())
    rbm, base = as_two_layers(dbm).rbm, base_on_first_class(dbm, base)
    folded = settings.estimate(rbm, x[..., dbm.classes[0]], generator=generator.set_state(state), base=base)
    assert folded.log_weights.equal(down.log_weights)


def log_samples(model, n, generator):
    """Exact samples (v, h)."""
    x = binary_states(model.n_units, like=model.b)
    at = torch.multinomial(log_joint(model).flatten(-2).softmax(-1), n, replacement=True, generator=generator)
    return x[at].split((model.n_visible, model.n_hidden), dim=-1)


@MODELS
@pytest.mark.parametrize("replicas", [(), (2, 3)], ids=str)
def test_exact_phases_give_the_gradient_of_the_enumerated_likelihood(make, replicas):
    model = make(replicas=replicas).double()
    v = binary_states(model.n_visible, like=model.b)[::5].expand(*replicas, -1, -1)
    generator = rng.stream(0, "unused")
    exact = Exact()
    positive = ExactPosterior().sample(model, v, generator=generator).configurations
    state = exact.init(model, 1, generator=generator)
    negative = exact.sample(model, state, positive, generator=generator).configurations
    found = torch.autograd.grad(contrast(model, positive, negative).sum(), list(model.parameters()))

    x = binary_states(model.n_units, like=model.b)
    x = x.expand(*replicas, *x.shape)
    joint = -model.energy(x[..., : model.n_visible], x[..., model.n_visible :])
    joint = joint.unflatten(-1, (2**model.n_visible, -1))
    log_p = joint.logsumexp(-1)[..., ::5] - joint.logsumexp((-2, -1)).unsqueeze(-1)
    expected = torch.autograd.grad(-log_p.mean(-1).sum(), list(model.parameters()))
    torch.testing.assert_close(found, expected)


def test_what_is_too_large_to_enumerate_is_refused():
    with pytest.raises(SettingError, match="units outside the largest class = 29"):
        log_partition_function(BoltzmannMachine(20, 10))
    with pytest.raises(SettingError, match="units outside the largest class = 17"):
        log_likelihood(BoltzmannMachine(2, 18), torch.zeros(1, 2), torch.zeros(()))
    with pytest.raises(SettingError, match="units to enumerate = 18"):
        Exact().init(BoltzmannMachine(10, 9), 1, generator=rng.stream(0, "unused"))
    with pytest.raises(SettingError, match="number of hidden units = 17"):
        ExactPosterior().sample(DBM(3, [10, 7]), torch.zeros(1, 3), generator=rng.stream(0, "unused"))


def test_mean_field_says_whether_it_converged():
    model, v = small_machine(replicas=(2,)), torch.zeros(2, 3, 4)
    generator = rng.stream(0, "unused")
    found = MeanField(tolerance=1e-6, max_iterations=200).sample(model, v, generator=generator).info
    assert found["mean_field_converged"].tolist() == [1.0, 1.0]
    hasty = MeanField(tolerance=1e-6, max_iterations=1).sample(model, v, generator=generator).info
    assert hasty["mean_field_converged"].tolist() == [0.0, 0.0]


def test_cd_starts_at_data_and_inferred_hidden_units():
    """At zero couplings nothing moves but by the biases: CD of any k draws from the biases."""
    model = small_dbm().double()
    with torch.no_grad():
        model.coupling.zero_()
    v = torch.zeros(20_000, 5).double()
    generator = rng.stream(0, "negative_phase")
    positive = MeanField().sample(model, v, generator=generator).configurations
    cd = CD(k=2)
    state = cd.init(model, 1, generator=generator)
    negative = cd.sample(model, state, positive, generator=generator).configurations
    torch.testing.assert_close(negative.v.mean(0), model.b.detach().sigmoid(), rtol=0, atol=0.02)
    torch.testing.assert_close(negative.h.mean(0), model.c.detach().sigmoid(), rtol=0, atol=0.02)


@pytest.mark.parametrize("make", [small_dbm, small_machine, small_grid])
@pytest.mark.parametrize("replicas", [(), (2, 3)], ids=str)
def test_the_ground_state_is_that_of_all_states_whatever_the_layout(make, replicas):
    """A DBM is solved as a matrix between its two classes of units, others as a list of pairs."""
    model, generator = make(replicas=replicas).double(), rng.stream(0, "solver")
    sampler = GroundState(solver=BruteForce())
    state = sampler.init(model, 1, generator=generator)
    v = torch.zeros(*replicas, 2, model.n_visible).double()
    positive = MeanField().sample(model, v, generator=generator)
    found = sampler.sample(model, state, positive.configurations, generator=generator).configurations
    lowest = -log_joint(model).flatten(-2).amax(-1)
    torch.testing.assert_close(model.energy(found.v.double(), found.h.double()).squeeze(-1).detach(), lowest)
