"""Moments of chains of units of every kind against all states; each test sees its mutants."""

import copy
from functools import partial

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, units
from memcomp_lightning.models.chains import TwoLayerChains
from memcomp_lightning.samplers import CD, PCD, ClampedGibbs, ParallelTempering, positive_phase
from memcomp_lightning.testing import (
    chi_square_p_value,
    enumerated,
    hidden_kinds,
    most_errors_off,
    small_dbm,
    small_machine,
    small_rbm,
    state_counts,
    visible_kinds,
)

N_CHAINS, N_SWEEPS = 20_011, 16
MOST = 6.5
"""Standard errors: of the hundreds of moments of all tests one is further off once in a million runs."""
V, H = visible_kinds(), hidden_kinds()
MAKERS = {
    "spins": partial(small_rbm, visible=V["spins"], hidden=H["spins"]),
    "categories": partial(small_rbm, visible=V["categories"], hidden=H["bits"]),
    "categories of several sizes": partial(
        small_rbm, visible=V["categories of several sizes"], hidden=H["categories"]
    ),
    "real": partial(small_rbm, visible=V["real"], hidden=H["spins"]),
    "mixed": partial(small_rbm, visible=V["mixed"], hidden=H["bits"]),
    "machine of spins": partial(small_machine, visible=V["spins"], hidden=H["bits"]),
    "machine of categories": partial(small_machine, visible=V["categories of several sizes"], hidden=H["spins"]),
    "mixed machine": partial(small_machine, visible=V["mixed"], hidden=H["spins"]),
    "mixed DBM": partial(small_dbm, visible=V["mixed"]),
}


def mild(make):
    """A model whose couplings are half of those of the kit's, so that its chains settle within a few sweeps."""
    model = make()
    couplings(model).data.mul_(0.5)
    return model


def couplings(model):
    return model.weight if isinstance(model, RBM) else model.coupling


MODELS = {name: partial(mild, make) for name, make in MAKERS.items()}
EVERY = pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)


def drawn(model, configurations, seed=0):
    """All units of configurations, with those of the last class drawn that stand as means."""
    x, last = torch.cat(configurations[:2], dim=-1), model.blocks()[-1]
    if last.kind.linear:
        stream = rng.stream(seed, "means")
        x[..., last.units] = last.kind.sample_of_mean(x[..., last.units], generator=stream)
    return x


def mutants(model):
    """A hotter model, one whose hidden biases changed places, and, of real units, one of another variance."""
    hotter, swapped, wider = (copy.deepcopy(model) for _ in range(3))
    with torch.no_grad():
        hotter.b *= 1.25
        couplings(hotter).data.mul_(1.25)
        swapped.c.copy_(swapped.c.flip(-1) + 0.2)
        for name, parameter in wider.named_parameters():
            if name.endswith("precision"):
                parameter *= 0.9
    return [hotter, swapped] + ([wider] if model.visible.real else [])


def by_cd(model):
    stream = rng.stream(0, "negative_phase")
    v = model.visible.sample(torch.zeros(N_CHAINS, model.n_visible), generator=stream)
    sampler = CD(k=N_SWEEPS)
    state = sampler.init(model, 1, generator=stream)
    return sampler.sample(model, state, positive_phase(model, v), generator=stream).configurations


def by_chains(sampler):
    def draw(model):
        stream = rng.stream(0, "negative_phase")
        state = sampler.init(model, 1, generator=stream)
        for _ in range(N_SWEEPS // 2):
            found = sampler.sample(model, state, None, generator=stream)
            state = found.state
        return found.configurations

    return draw


PT = by_chains(ParallelTempering(k=2, n_chains=N_CHAINS, n_temperatures=3, adaptation=0.0))
SAMPLERS = {"CD": by_cd, "PCD": by_chains(PCD(k=2, n_chains=N_CHAINS)), "PT": PT}


@pytest.mark.parametrize("draw", SAMPLERS.values(), ids=SAMPLERS)
@EVERY
def test_chains_have_the_moments_of_the_model_and_those_of_mutants_do_not(make, draw):
    model = make()
    x, exact = drawn(model, draw(model)), enumerated(copy.deepcopy(model).double())
    assert most_errors_off(x, exact) < MOST
    for mutant in mutants(model):
        assert most_errors_off(x, enumerated(mutant.double())) > MOST


def tempered(model, beta, measure=1.0):
    """The model of exp(-beta E), where beta does not multiply the measure but ``measure`` does."""
    other = copy.deepcopy(model).double()
    with torch.no_grad():
        for name, parameter in other.named_parameters():
            parameter *= measure if name.endswith("precision") else beta
    return other


@EVERY
def test_tempered_sweeps_multiply_the_fields_and_leave_the_measure(make):
    model, stream = make(), rng.stream(0, "negative_phase")
    chains = model.chains()
    x = chains.random(N_CHAINS, generator=stream)
    for _ in range(N_SWEEPS):
        x = chains.sweep(x, beta=0.6, generator=stream)
    if x.shape[-1] == model.n_visible:
        hidden = model.draw_hidden(x, beta=0.6, generator=stream)
        x = torch.cat((x, hidden), dim=-1)
    assert most_errors_off(x, enumerated(tempered(model, 0.6))) < MOST
    assert most_errors_off(x, enumerated(copy.deepcopy(model).double())) > MOST
    if model.visible.real:
        assert most_errors_off(x, enumerated(tempered(model, 0.6, measure=0.6))) > MOST


def test_exchanges_by_energies_with_the_measure_show(monkeypatch):
    model = MODELS["real"]()
    with torch.no_grad():
        model.weight *= 1.5
    exact = enumerated(copy.deepcopy(model).double())
    assert most_errors_off(drawn(model, PT(model)), exact) < MOST

    def with_measure(self, x, *, beta, generator):
        h = model.draw_hidden(x, beta=beta, generator=generator)
        v = model.draw_visible(h, beta=beta, generator=generator)
        return v, model.energy(v, h)

    monkeypatch.setattr(TwoLayerChains, "swept_with_energy", with_measure)
    assert most_errors_off(drawn(model, PT(model)), exact) > MOST


@EVERY
def test_clamped_chains_have_the_posterior_of_hidden_units_and_of_what_is_missing(make):
    model, stream = make(), rng.stream(0, "positive_phase")
    zero = torch.zeros(3, model.n_visible)
    v = model.visible.sample(zero, generator=stream)[2]
    known = torch.tensor([True, False, False, True, False, True])[: model.visible.n_sites]
    observed = model.visible.over_sites(known)
    # What stands at missing places is not read.
    given = torch.where(observed, v, torch.nan)
    found = ClampedGibbs(k=N_SWEEPS, n_chains=N_CHAINS).sample(
        model, given.view(1, -1), observed=observed.view(1, -1), generator=stream
    )
    x = torch.cat(found.configurations[:2], dim=-1)
    assert x[:, : model.n_visible][:, observed].equal(v[observed].expand(N_CHAINS, -1))
    last = [block for block in model.blocks() if bool((block.units >= model.n_visible).any())][-1]
    at = last.units[last.units >= model.n_visible] - model.n_visible
    kind = model.hidden.select(at)
    places = at + model.n_visible
    x[:, places] = kind.sample_of_mean(x[:, places], generator=rng.stream(0, "means"))
    double = copy.deepcopy(model).double()
    assert most_errors_off(x, enumerated(double, v.double(), observed)) < MOST
    assert most_errors_off(x, enumerated(double)) > MOST
    for mutant in mutants(model)[:2]:
        assert most_errors_off(x, enumerated(mutant.double(), v.double(), observed)) > MOST


def test_chains_with_rectified_units_have_the_distribution_of_their_integrals():
    model = small_rbm(visible=V["bits"], hidden=H["rectified"])
    v = units.all_states(model.visible, model.b)
    t = torch.linspace(0, 40, 8001, dtype=torch.float64)
    field = model.hidden_field(v).detach().double().unsqueeze(-1)
    log_of_each = torch.logsumexp(field * t - t.square() / 2, dim=-1)
    log_p = (v @ model.b.detach()).double() + log_of_each.sum(-1)
    counts = state_counts(PCDS(model).v)
    assert chi_square_p_value(counts, log_p.softmax(-1)) > 1e-7
    as_normal = (v @ model.b.detach()).double() + field.squeeze(-1).square().sum(-1) / 2
    assert chi_square_p_value(counts, as_normal.softmax(-1)) < 1e-7


PCDS = SAMPLERS["PCD"]
