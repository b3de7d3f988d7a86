"""Data with missing values: gradients, likelihoods and positive phases are those of what is observed."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import RBM, BoltzmannMachine, observed, start_at_means
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin, Units
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import ClampedGibbs, ExactPosterior, MeanField
from memcomp_lightning.samplers.positive import exact
from memcomp_lightning.testing import brute_force, small_machines, small_rbms
from memcomp_lightning.types import Configurations


def coupled_visible(model):
    pairs = model.quadratic_form().pairs
    return pairs is not None and bool((pairs < model.n_visible).all(-1).any())


def split_colours(*, replicas=()):
    """No visible units are coupled, but one is drawn together with a hidden unit that others are coupled to."""
    pairs = [(0, 3), (1, 4), (2, 4), (1, 5), (3, 4), (3, 5), (0, 5)]
    machine = BoltzmannMachine(
        visible=Mixed(Spin(2), Gaussian(1)), hidden=Spin(3), connectivity=pairs, replicas=replicas
    )
    with torch.no_grad():
        for number, parameter in enumerate((machine.coupling, machine.b, machine.c)):
            parameter.uniform_(-1, 1, generator=rng.stream(number, "test model"))
    return machine


MODELS = {
    name: make
    for name, make in (small_rbms() | small_machines() | {"split colours": split_colours}).items()
    if not (make().hidden.real or coupled_visible(make()))
}
of_all = pytest.mark.parametrize("name", MODELS)


def masked(model, n=5):
    """Data, nan where missing, and masks that hide single sites, many of them and, in the last row, none."""
    generator = rng.stream(0, "missing")
    shape = (*model.replicas, n, model.n_visible)
    field = rng.uniform(shape, generator=generator, like=model.b) - 0.5
    v = model.visible.sample(field, generator=generator)
    of_sites = rng.uniform((*shape[:-1], model.visible.n_sites), generator=generator) < 0.5
    of_sites[..., 0, 1:] = False
    of_sites[..., 0, 0] = of_sites[..., 1, -1] = True
    of_sites[..., -1, :] = True
    known = model.visible.over_sites(of_sites)
    return torch.where(known, v, torch.nan), known


def close(found, true, tolerance=1e-9):
    torch.testing.assert_close(found, true, rtol=tolerance, atol=tolerance)


def check_likelihood(name):
    model = MODELS[name]().double()
    v, known = masked(model)
    log_z = log_partition_function(model)
    close(log_likelihood(model, v, log_z, observed=known), brute_force.log_likelihood(model, v, known).detach())


@of_all
def test_likelihood_is_that_of_what_is_observed(name):
    check_likelihood(name)


def part(model, make, at):
    """The model of one replica."""
    alone = make().double()
    with torch.no_grad():
        for key, tensor in alone.state_dict().items():
            if tensor.is_floating_point():
                tensor.copy_(model.state_dict()[key][at])
    return alone


def positive_phase(model, v, known):
    return ExactPosterior().sample(model, v, observed=known, generator=rng.stream(0, "unused")).configurations


def check_gradient(name):
    model = MODELS[name]().double()
    v, known = masked(model)
    assert not bool(known.all())
    parameters = list(model.parameters())
    loss = contrast(model, positive_phase(model, v, known), model.all_configurations())
    found = torch.autograd.grad(loss, parameters)
    true = torch.autograd.grad(-brute_force.log_likelihood(model, v, known).mean(), parameters)
    close(found, true)


@of_all
def test_gradient_is_that_of_the_likelihood_of_what_is_observed(name):
    check_gradient(name)


@of_all
def test_replicas_have_masks_of_their_own(name):
    make = MODELS[name]
    model = make(replicas=(2,)).double()
    v, known = masked(model)
    log_z = log_partition_function(model)
    log_p = log_likelihood(model, v, log_z, observed=known)
    positive = positive_phase(model, v, known)
    found = torch.autograd.grad(model.mean_energy(positive).sum(), list(model.parameters()))
    for at in range(2):
        alone = part(model, make, at)
        close(log_p[at], log_likelihood(alone, v[at], log_z[at], observed=known[at]))
        own = positive_phase(alone, v[at], known[at])
        gradient = torch.autograd.grad(alone.mean_energy(own), list(alone.parameters()))
        close([some[at] for some in found], list(gradient))


def test_what_stands_where_a_value_is_missing_is_not_read():
    model = MODELS["mixed x spins"]().double()
    v, known = masked(model)
    log_z = log_partition_function(model)
    expected = log_likelihood(model, v, log_z, observed=known), positive_phase(model, v, known)
    for value in (0.0, 1e9, torch.inf):
        other = torch.where(known, v, value)
        close(log_likelihood(model, other, log_z, observed=known), expected[0])
        for ours, true in zip(positive_phase(model, other, known), expected[1], strict=True):
            close(ours, true)


def test_where_nothing_is_observed_the_probability_is_one():
    model = MODELS["mixed x bits"]().double()
    v, known = masked(model)
    log_z = log_partition_function(model)
    nothing = torch.zeros_like(known)
    close(log_likelihood(model, v, log_z, observed=nothing), torch.zeros(len(v), dtype=torch.float64))


# --- where it cannot be summed ----------------------------------------------------------------------------

ALL = small_rbms() | small_machines()


@pytest.mark.parametrize("name", [name for name in ALL if not ALL[name]().hidden.real])
def test_mean_field_of_what_is_missing_is_its_fixed_point(name):
    model = ALL[name](replicas=(2,)).double()
    v, known = masked(model)
    found = MeanField(max_iterations=2000, tolerance=1e-12).sample(
        model, v, observed=known, generator=rng.stream(0, "unused")
    )
    assert bool(found.info["mean_field_converged"].all())
    n_points = found.configurations.v.shape[-2] // v.shape[-2]
    assert n_points == (1 if model.visible.linear else 2)
    filled, h = (x.unflatten(-2, (-1, n_points)) for x in found.configurations[:2])
    means = filled.mean(-2)
    assert means[known].equal(v[known])
    for at in range(2):
        alone = part(model, ALL[name], at)
        bias = torch.cat((alone.b, alone.c)).detach()
        x = torch.cat((means[at], h[at, :, 0]), dim=-1)
        field = x @ brute_force.couplings(alone).detach() + bias
        n = model.n_visible
        close(h[at, :, 0], alone.hidden.mean(field[:, n:]), 1e-8)
        expected = alone.visible.mean(field[:, :n]).detach()
        close(means[at], torch.where(known[at], v[at], expected), 1e-8)
        for site in brute_force.sites_of(alone.visible):
            if site.precision is not None:
                entry = site.entries[0]
                spread = filled[at, :, :, entry].var(-1, correction=0)
                variance = torch.where(known[at, :, entry], 0.0, 1 / site.precision.detach())
                close(spread, variance)


def check_chains(name):
    """The gradient of the energy, for each row of data; its error is that of batches of chains."""
    model = ALL[name]().double()
    v, known = (x[:2] for x in masked(model))  # few and many known values
    n_batches, n_chains, parameters = 20, 200, list(model.parameters())
    sampler = ClampedGibbs(k=12, n_chains=n_batches * n_chains)
    found = sampler.sample(model, v, observed=known, generator=rng.stream(0, "chains")).configurations
    x = torch.cat((v, v.new_zeros(len(v), model.n_hidden)), dim=-1)
    at = torch.cat((known, torch.zeros(len(v), model.n_hidden, dtype=torch.bool)), dim=-1)
    of_rows = (some.view(len(v), n_batches, n_chains, -1) for some in found[:2])
    for row, (chains, hidden) in enumerate(zip(*of_rows, strict=True)):
        assert bool((chains == v[row])[..., known[row]].all())
        expected = torch.autograd.grad(-brute_force.log_sum(model, x[row], at[row]), parameters)
        batches = [
            torch.autograd.grad(model.mean_energy(Configurations(*some)), parameters)
            for some in zip(chains, hidden, strict=True)
        ]
        for one, true in zip(zip(*batches, strict=True), expected, strict=True):
            if true.numel():
                ours = torch.stack(one)
                # Student's t of 19 degrees of freedom: once in 10^7.
                error = ours.std(0) / n_batches**0.5
                assert bool(((ours.mean(0) - true).abs() <= 9 * error + 1e-9).all())


@pytest.mark.parametrize(
    "name",
    [
        "spins x bits",
        "categories x ReLU",
        "real x spins",
        "mixed x bits",
        "spins, all pairs",
        "mixed",
        "mixed alone",
        "categories alone",
        "DBM of mixed units",
    ],
)
def test_gibbs_chains_of_what_is_missing_have_the_expectations(name):
    check_chains(name)


# --- masks that are refused -------------------------------------------------------------------------------


def good():
    model = RBM(visible=Mixed(Bernoulli(1), Categorical([2, 3]), Gaussian(1)), hidden=Spin(2))
    v = torch.tensor([[1, 0, 1, 0, 0, 1, 0.5], [0, 1, 0, 1, 0, 0, 2.5], [1, 1, 0, 1, 0, 0, 1.5]])
    return model, v, torch.ones_like(v, dtype=torch.bool)


def test_masks_that_hide_everything_or_half_a_site_are_refused():
    model, v, mask = good()
    start_at_means(model, v, mask)
    for change, message in (
        (
            (1, slice(None)),
            r"observed values in row 1 = 0 is not allowed: expected one or more. Leave out the row",
        ),
        ((slice(None), 0), r"observed values in column 0 = 0 .*Leave out the column"),
        ((slice(None), slice(None)), r"observed values in row 0 = 0"),
        ((2, 4), r"observed entries of site 2 in row 2 = 'a part' .*all entries of a site, or none"),
    ):
        wrong = mask.clone()
        wrong[change] = False
        with pytest.raises(SettingError, match=message):
            start_at_means(model, v, wrong)
    for wrong, message in ((mask[:2], r"shape of observed = \(2, 7\)"), (mask.float(), "dtype of observed")):
        with pytest.raises(SettingError, match=message):
            start_at_means(model, v, wrong)
        with pytest.raises(SettingError, match=message):
            log_likelihood(model, v, torch.zeros(()), observed=wrong)
    half = mask.clone()
    half[2, 4] = False
    with pytest.raises(SettingError, match="observed entries of site 2"):
        log_likelihood(model, v, torch.zeros(()), observed=half)


def test_observed_values_are_checked_and_missing_ones_are_not():
    model, v, mask = good()
    for column, value, message in ((0, 7.0, "column 0, row 1 = 7"), (6, torch.nan, "column 3, row 1 = nan")):
        wrong = v.clone()
        wrong[1, column] = value
        with pytest.raises(SettingError, match=message):
            start_at_means(model, wrong, mask)
        with pytest.raises(SettingError, match=message):
            log_likelihood(model, wrong, torch.zeros(()), observed=mask)
        known = mask.clone()
        known[1, column] = False
        start_at_means(model, wrong, known)
        log_likelihood(model, wrong, torch.zeros(()), observed=known)


def test_machines_with_couplings_between_visible_units_cannot_sum_what_is_missing():
    model = small_machines()["mixed"]()
    v, known = masked(model)
    with pytest.raises(SettingError, match=r"couplings between visible units = True .*clamped_gibbs"):
        log_likelihood(model, v, torch.zeros(()), observed=known)


def test_more_hidden_units_than_can_be_summed_are_refused():
    model = RBM(visible=Spin(3), hidden=Spin(20))
    known = torch.ones(2, 3, dtype=torch.bool)
    with pytest.raises(SettingError, match=r"number of hidden units = 20 .*16 where values are missing"):
        log_likelihood(model, torch.ones(2, 3), torch.zeros(()), observed=known)


# --- mutants ----------------------------------------------------------------------------------------------


def all_observed(right):
    """The mask is not looked at: missing values are taken to be zero, or the first state."""

    def log_weight(model, v, observed, h):
        v = torch.where(observed, v, model.visible.mode(torch.zeros_like(v)))
        return right(model, v, torch.ones_like(observed), h)

    return log_weight


def not_summed(right):
    def log_weight(model, v, observed, h):
        field = observed_fields(model, h)
        missing = (model.visible.site_sums(observed.to(v.dtype)) == 0).to(v.dtype)
        return right(model, v, observed, h) - missing @ model.visible.cumulant(field).mT

    return log_weight


observed_fields = observed.visible_field


MUTANTS = {
    "spins: the mask is not looked at": (
        exact,
        "log_weight_of_hidden",
        all_observed,
        check_gradient,
        "spins x bits",
    ),
    "real: missing values are not summed": (
        exact,
        "log_weight_of_hidden",
        not_summed,
        check_gradient,
        "real x bits",
    ),
    "categories: missing values are not summed": (
        exact,
        "log_weight_of_hidden",
        not_summed,
        check_gradient,
        "categories x spins",
    ),
    "real: missing values without spread": (
        Gaussian,
        "points",
        lambda _: Units.points,
        check_gradient,
        "real x spins",
    ),
    "mixed: missing values without spread": (
        Gaussian,
        "points",
        lambda _: Units.points,
        check_gradient,
        "mixed x categories",
    ),
    "bits: fields of missing values": (
        exact,
        "visible_field",
        lambda right: lambda model, h: 0.5 * right(model, h),
        check_gradient,
        "bits x spins",
    ),
    "chains: too hot": (
        Spin,
        "sample",
        lambda right: lambda self, field, *, generator: right(self, 0.7 * field, generator=generator),
        check_chains,
        "spins, all pairs",
    ),
    "chains: too wide": (
        Gaussian,
        "sample",
        lambda right: lambda self, field, *, generator: 1.2 * right(self, field, generator=generator),
        check_chains,
        "mixed",
    ),
    "likelihood: the mask is not looked at": (
        "memcomp_lightning.likelihood.exact",
        "log_weight_of_hidden",
        all_observed,
        check_likelihood,
        "mixed x bits",
    ),
}


@pytest.mark.parametrize(("owner", "attribute", "change", "check", "name"), MUTANTS.values(), ids=MUTANTS)
def test_a_mutant_is_seen(owner, attribute, change, check, name, monkeypatch):
    check(name)
    if isinstance(owner, str):
        monkeypatch.setattr(f"{owner}.{attribute}", change(observed.log_weight_of_hidden))
    else:
        monkeypatch.setattr(owner, attribute, change(getattr(owner, attribute)))
    with pytest.raises(AssertionError):
        check(name)
