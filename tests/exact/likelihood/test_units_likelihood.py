"""Likelihoods of models of all kinds of units against sums over all states and integrals."""

import itertools

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import (
    Ais,
    ReverseAis,
    ais,
    base_of,
    bits,
    exact_samples,
    kl_divergence,
    log_likelihood,
    log_likelihood_bound,
    log_partition_function,
    log_pseudo_likelihood,
    pseudo,
)
from memcomp_lightning.models import DBM, RBM, BoltzmannMachine
from memcomp_lightning.models.mean_field import hidden_blocks
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, ReLU, Spin, all_states
from memcomp_lightning.testing import brute_force, chi_square_p_value, small_machines, small_rbms

RBMS, MACHINES = small_rbms(), small_machines()
MODELS = RBMS | MACHINES
FOLDED = {name: make for name, make in MACHINES.items() if isinstance(make(), DBM)}


def data(model, n=4):
    generator = rng.stream(0, "configurations")
    field = rng.uniform((*model.replicas, n, model.n_visible), generator=generator, like=model.b) - 0.5
    return model.visible.sample(field, generator=generator)


def close(found, true, tolerance=1e-9):
    torch.testing.assert_close(found, true, rtol=tolerance, atol=tolerance)


# --- exact ones -------------------------------------------------------------------------------------------


def check_log_z(name):
    model = MODELS[name]()
    true = brute_force.log_sum(model.double()).detach()
    close(log_partition_function(model), true)
    close(log_partition_function(model.float()), true, 1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_log_z_is_that_of_all_states(name):
    check_log_z(name)


def check_log_likelihood(name):
    model = MODELS[name]().double()
    v = data(model)
    true = brute_force.log_likelihood(model, v).detach()
    log_z = log_partition_function(model)
    close(log_likelihood(model, v, log_z), true)
    if not (model.hidden.real or _coupled_visible(model)):
        close(log_likelihood(model, v, log_z, observed=torch.ones_like(v, dtype=torch.bool)), true)
    if not model.hidden.real:
        bound = log_likelihood_bound(model, v, log_z, tolerance=1e-10, max_iterations=1000)
        assert bool((true - bound > -1e-9).all())
        coupled = any(bool((block.neighbours >= model.n_visible).any()) for block in hidden_blocks(model))
        if not coupled:
            close(bound, true)


def _coupled_visible(model):
    pairs = model.quadratic_form().pairs
    return pairs is not None and bool((pairs < model.n_visible).all(-1).any())


@pytest.mark.parametrize("name", MODELS)
def test_log_likelihood_is_that_of_all_states(name):
    check_log_likelihood(name)


@pytest.mark.parametrize("name", ["spins x spins", "ragged categories x bits", "mixed without real ones x ReLU"])
def test_kl_divergence_counts_rows(name):
    model = MODELS[name]().double()
    v = data(model)[[0, 0, 1, 0]]
    share = torch.tensor([3 / 4, 3 / 4, 1 / 4, 3 / 4], dtype=torch.float64)
    assert not v[0].equal(v[2])
    close(kl_divergence(model, v), (share.log() - brute_force.log_likelihood(model, v).detach()).mean())


def test_kl_divergence_of_real_units_is_refused():
    model = RBMS["mixed x bits"]()
    with pytest.raises(
        SettingError, match="visible units = 'Mixed' is not allowed: expected units that are not real"
    ):
        kl_divergence(model, data(model))


def check_pseudo(name):
    model = MODELS[name]().double()
    v = data(model, 3)
    known = torch.arange(model.n_units) < model.n_visible
    rows = torch.cat((v, v.new_zeros(len(v), model.n_hidden)), dim=-1)
    found = log_pseudo_likelihood(model, v)
    assert found.shape == (3, model.visible.n_sites)
    for number, site in enumerate(brute_force.sites_of(model.visible)):
        others = known.clone()
        others[site.entries] = False
        for at, row in enumerate(rows):
            true = brute_force.log_sum(model, row, known) - brute_force.log_sum(model, row, others)
            close(found[at, number], true.detach())


@pytest.mark.parametrize("name", MODELS)
def test_pseudo_likelihood_is_that_of_each_site_given_the_others(name):
    check_pseudo(name)


@pytest.mark.parametrize("name", MODELS)
def test_likelihoods_of_replicas_are_those_of_each(name):
    make = MODELS[name]
    model = make(replicas=(2, 1)).double()
    v = data(model, 3)
    log_z, found = log_partition_function(model), log_pseudo_likelihood(model, v)
    log_p = log_likelihood(model, v, log_z)
    for at in range(2):
        alone = make().double()
        with torch.no_grad():
            for key, tensor in alone.state_dict().items():
                if tensor.is_floating_point():
                    tensor.copy_(model.state_dict()[key][at, 0])
        own = log_partition_function(alone)
        close(log_z[at, 0], own)
        close(log_p[at, 0], log_likelihood(alone, v[at, 0], own))
        close(found[at, 0], log_pseudo_likelihood(alone, v[at, 0]))


def test_visible_units_without_a_precision_have_no_pseudo_likelihood():
    model = RBM(visible=ReLU(2), hidden=Spin(2))
    with pytest.raises(
        SettingError, match="units = 'ReLU' is not allowed: expected units with a form in bits, as"
    ):
        log_pseudo_likelihood(model, torch.ones(1, 2))


# --- samples ----------------------------------------------------------------------------------------------


def check_samples(name, n=5000):
    model = RBMS[name](replicas=(2,)).double()
    v = exact_samples(model, n, generator=rng.stream(0, "samples"))
    assert v.shape == (2, n, model.n_visible)
    model.visible.check(v, pure=True)
    for at in range(2):
        alone = RBMS[name]().double()
        with torch.no_grad():
            for key, tensor in alone.state_dict().items():
                tensor.copy_(model.state_dict()[key][at])
        if not model.visible.real:
            states = all_states(model.visible, model.b)
            p = brute_force.log_likelihood(alone, states).detach().exp()
            number = (v[at].unsqueeze(-2) == states).all(-1).to(torch.uint8).argmax(-1)
            assert chi_square_p_value(torch.bincount(number, minlength=len(states)), p) > 1e-7
            continue
        known = list(alone.parameters())
        moments = dict(
            zip(
                [k for k, _ in alone.named_parameters()],
                torch.autograd.grad(brute_force.log_sum(alone), known),
                strict=True,
            )
        )
        h = alone.hidden_mean(v[at]).detach()
        features = {"b": v[at], "c": h, "weight": (h.unsqueeze(-1) * v[at].unsqueeze(-2)).flatten(-2)}
        for key, expected in moments.items():
            if key.endswith("precision"):
                entries = [s.entries[0] for s in brute_force.sites_of(alone.visible) if s.precision is not None]
                features[key] = -0.5 * v[at][:, entries[: len(expected)]].square()
            found = features[key]
            error = found.std(0) / n**0.5
            assert bool(((found.mean(0) - expected.flatten()).abs() < 5.5 * error + 1e-12).all()), key


@pytest.mark.parametrize("name", RBMS)
def test_exact_samples_are_those_of_the_model(name):
    check_samples(name)


def test_samples_of_a_machine_are_refused():
    with pytest.raises(SettingError, match=r"model = 'DBM' is not allowed: expected an RBM.*as_two_layers"):
        exact_samples(MACHINES["DBM of spins"](), 3, generator=rng.stream(0, "samples"))


# --- annealing --------------------------------------------------------------------------------------------


def check_annealing(name, n_chains=300):
    make = RBMS[name] if name in RBMS else FOLDED[name]
    model = make(replicas=(2,)).double()
    true = log_partition_function(model)
    generator = rng.stream(0, "annealing")
    v = data(model, 30)
    base = None if name in FOLDED else base_of(v, model.visible)
    up = Ais(n_chains=n_chains, n_betas=40).estimate(model, generator=generator, base=base)
    assert bool(((up.log_z - true).abs() < 5.5 * up.standard_error + 1e-9).all()), up
    assert bool((up.effective_sample_size > n_chains / 10).all())
    if name in RBMS:
        samples = exact_samples(model, n_chains, generator=generator)
        down = ReverseAis(n_betas=40).estimate(model, samples, generator=generator, base=base)
        assert bool(((down.log_z - true).abs() < 5.5 * down.standard_error + 1e-9).all()), down


@pytest.mark.parametrize("name", [*RBMS, *FOLDED])
def test_annealing_from_both_sides_finds_log_z(name):
    check_annealing(name)


def test_annealing_without_couplings_is_exact():
    """A base that is the model: all weights are one, and real units keep their precision."""
    model = RBMS["mixed x spins"]().double()
    with torch.no_grad():
        model.weight.zero_()
        model.c.zero_()
    found = Ais(n_chains=3, n_betas=2).estimate(model, generator=rng.stream(0, "ais"), base=model.b.detach())
    close(found.log_z, brute_force.log_sum(model).detach())
    close(found.log_weights, torch.zeros(3, dtype=torch.float64))


# --- mutants ----------------------------------------------------------------------------------------------


def times(factor):
    return lambda right: lambda *given, **settings: factor * right(*given, **settings)


def constant(shift):
    return lambda right: lambda *given, **settings: right(*given, **settings) + shift


def hotter(right):
    return lambda self, field, *, generator: right(self, 0.7 * field, generator=generator)


def wider(right):
    """The measure takes part in the annealing."""
    return lambda self, field, *, generator: 1.4 * right(self, field, generator=generator)


def without_offset(right):
    return lambda model: found._replace(offset=0 * found.offset) if (found := right(model)) else None


def coarse(right):
    return 0.5


MUTANTS = {
    "bits: log Z": (Bernoulli, "cumulant", times(2.0), check_log_z, "mixed x bits"),
    "spins: log Z without the offset": ("exact", "in_bits", without_offset, check_log_z, "spins x spins"),
    "categories: log Z": (Categorical, "cumulant", constant(0.1), check_log_z, "categories x bits"),
    "real: log Z without 2 pi": (Gaussian, "cumulant", constant(-0.9189), check_log_z, "real x bits"),
    "ReLU: log Z": (ReLU, "cumulant", constant(0.01), check_log_z, "bits x ReLU"),
    "bits: likelihood": (RBM, "free_energy", times(2.0), check_log_likelihood, "bits x bits"),
    "spins: likelihood": (Spin, "cumulant", constant(0.1), check_log_likelihood, "spins x spins"),
    "categories: likelihood of a machine": (
        BoltzmannMachine,
        "tempered_energy",
        times(-1.0),
        check_log_likelihood,
        "categories, all pairs",
    ),
    "real: likelihood without the measure": (Gaussian, "energy", times(0.0), check_log_likelihood, "real x bits"),
    "spins: pseudo-likelihood": (pseudo, "_discrete_of_rbm", times(2.0), check_pseudo, "spins x bits"),
    "categories: pseudo-likelihood": (
        pseudo,
        "_other",
        lambda right: lambda state, k, sites: right(state, 1, sites),
        check_pseudo,
        "categories x bits",
    ),
    "machine: pseudo-likelihood": (pseudo, "_discrete", times(0.5), check_pseudo, "mixed"),
    "machine alone: pseudo-likelihood": (
        pseudo,
        "_of_visible_alone",
        constant(0.1),
        check_pseudo,
        "categories alone",
    ),
    "real: pseudo-likelihood by few nodes": (pseudo, "NODES_A_DEVIATION", coarse, check_pseudo, "real x bits"),
    "spins: samples": (Spin, "sample", hotter, check_samples, "spins x bits"),
    "categories: samples": (Categorical, "sample", hotter, check_samples, "categories x spins"),
    "real: samples": (Gaussian, "sample", wider, check_samples, "real x bits"),
    "bits: annealing": (Bernoulli, "cumulant_gain", times(0.9), check_annealing, "bits x bits"),
    "spins: annealing": (Spin, "cumulant_gain", times(0.9), check_annealing, "spins x spins"),
    "categories: annealing": (Categorical, "sample", hotter, check_annealing, "categories x bits"),
    "real: measure tempered": (Gaussian, "sample", wider, check_annealing, "real x bits"),
    "log Z of the base left out": (ais, "_log_z_of_base", times(0.0), check_annealing, "mixed x spins"),
}


@pytest.mark.parametrize(("owner", "attribute", "change", "check", "name"), MUTANTS.values(), ids=MUTANTS)
def test_a_mutant_is_seen(owner, attribute, change, check, name, monkeypatch):
    check(name)
    if owner == "exact":
        monkeypatch.setattr("memcomp_lightning.likelihood.exact.in_bits", change(bits.in_bits))
    else:
        monkeypatch.setattr(owner, attribute, change(getattr(owner, attribute)))
    with pytest.raises(AssertionError):
        check(name)


def test_all_visible_states_have_probability_one():
    for name in ("spins x spins", "categories x ReLU", "mixed without real ones x bits", "DBM of categories"):
        model = MODELS[name]().double()
        log_p = log_likelihood(model, all_states(model.visible, model.b.detach()), log_partition_function(model))
        close(log_p.exp().sum(), torch.ones((), dtype=torch.float64))


def test_density_of_real_units_has_the_integral_one():
    model = RBM(visible=Gaussian(2, variance=0.5), hidden=Spin(2)).double()
    axis = torch.linspace(-8, 8, 401, dtype=torch.float64)
    grid = torch.tensor(list(itertools.product(axis.tolist(), axis.tolist())), dtype=torch.float64)
    log_p = log_likelihood(model, grid, log_partition_function(model))
    close(log_p.exp().sum() * 0.04**2, torch.ones((), dtype=torch.float64))
