"""Distributions of chains drawn class by class against enumeration; each test rejects its mutants."""

import copy

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.samplers import CD, PCD, ClampedGibbs, MeanField, ParallelTempering
from memcomp_lightning.testing import chi_square_p_value, small_dbm, small_machine, state_counts

N_CHAINS = 60_013
N_SWEEPS = 15
LEVEL = 1e-7
"""A right sampler is rejected as rarely; a few thousand samples more make up for it."""
MODELS = pytest.mark.parametrize("make", [small_dbm, small_machine])


def probabilities(model, beta=1.0):
    x = binary_states(model.n_units, like=torch.zeros((), dtype=torch.float64))
    energy = copy.deepcopy(model).double().energy(x[:, : model.n_visible], x[:, model.n_visible :])
    return torch.softmax(-beta * energy.detach(), 0)


def counts(configurations, seed):
    """Counts of all units; those that are means are drawn."""
    x = torch.cat((configurations.v, configurations.h), dim=-1)
    return state_counts(rng.bernoulli(x, generator=rng.stream(seed, "means")))


def draw_cd(model, seed):
    generator = rng.stream(seed, "negative_phase")
    v = rng.bernoulli(torch.full((N_CHAINS, model.n_visible), 0.5), generator=generator)
    positive = MeanField().sample(model, v, generator=generator).configurations
    sampler = CD(k=N_SWEEPS)
    state = sampler.init(model, 1, generator=generator)
    return sampler.sample(model, state, positive, generator=generator).configurations


def by_chains(sampler):
    def draw(model, seed):
        generator = rng.stream(seed, "negative_phase")
        positive = MeanField().sample(model, torch.zeros(2, model.n_visible), generator=generator).configurations
        state = sampler.init(model, 2, generator=generator)
        for _ in range(N_SWEEPS // 3):
            negative = sampler.sample(model, state, positive, generator=generator)
            state = negative.state
        return negative.configurations

    return draw


SAMPLERS = {
    "CD": draw_cd,
    "PCD": by_chains(PCD(k=3, n_chains=N_CHAINS)),
    "PT": by_chains(ParallelTempering(k=3, n_chains=N_CHAINS, n_temperatures=3, adaptation=0.0)),
}


@MODELS
@pytest.mark.parametrize("draw", SAMPLERS.values(), ids=SAMPLERS)
def test_chains_have_the_boltzmann_distribution_and_those_of_mutants_do_not(make, draw):
    model = make()
    assert chi_square_p_value(counts(draw(model, 0), 0), probabilities(model)) > LEVEL
    hotter, swapped = copy.deepcopy(model), copy.deepcopy(model)
    with torch.no_grad():
        for parameter in hotter.parameters():
            parameter *= 1.07
        swapped.c.copy_(swapped.c.flip(-1))
    for mutant in (hotter, swapped):
        assert chi_square_p_value(counts(draw(mutant, 0), 0), probabilities(model)) < LEVEL


@MODELS
def test_tempered_sweeps_have_the_tempered_distribution(make):
    model, generator = make(), rng.stream(0, "negative_phase")
    chains = model.chains()
    x = chains.random(N_CHAINS, generator=generator)
    for _ in range(N_SWEEPS):
        x = chains.sweep(x, beta=0.6, generator=generator)
    assert chi_square_p_value(state_counts(x), probabilities(model, beta=0.6)) > LEVEL
    assert chi_square_p_value(state_counts(x), probabilities(model)) < LEVEL


@MODELS
def test_clamped_chains_have_the_posterior_distribution(make):
    model, generator = make(), rng.stream(0, "positive_phase")
    v = torch.tensor([1.0, 0.0, 1.0, 1.0, 0.0])[: model.n_visible]
    found = ClampedGibbs(k=20, n_chains=N_CHAINS).sample(model, v.view(1, -1), generator=generator)
    assert found.configurations.v.equal(v.expand(N_CHAINS, -1))
    h = rng.bernoulli(found.configurations.h, generator=rng.stream(0, "means"))
    clamped = probabilities(model).view(2**model.n_visible, -1)
    at = int(state_counts(v.view(1, -1)).argmax())
    assert chi_square_p_value(state_counts(h), clamped[at] / clamped[at].sum()) > LEVEL
    assert chi_square_p_value(state_counts(h), clamped[at - 1] / clamped[at - 1].sum()) < LEVEL
