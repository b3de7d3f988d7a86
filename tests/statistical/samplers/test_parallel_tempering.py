"""Parallel tempering: the right distribution at every temperature, exchanges that serve their purpose."""

import pytest
import torch
from test_gibbs_samplers import LEVEL, MUTANTS, changed, visible_probabilities

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import RBM
from memcomp_lightning.samplers import PCD, ParallelTempering, positive_phase
from memcomp_lightning.samplers.parallel_tempering import betas
from memcomp_lightning.testing import chi_square_p_value, state_counts
from memcomp_lightning.testing.conformance import small_rbm

N_CHAINS = 30_011


def run(rbm, sampler, n_calls, seed=0):
    """The last answer of a sampler that was called so often."""
    generator = rng.stream(seed, "negative_phase")
    state = sampler.init(rbm, 2, generator=generator)
    positive = positive_phase(rbm, torch.zeros(*rbm.replicas, 2, rbm.n_visible))
    for _ in range(n_calls):
        negative = sampler.sample(rbm, state, positive, generator=generator)
        state = negative.state
    return negative


def two_valleys(strength=9.0):
    """All ones or all zeros, with next to nothing between: Gibbs sampling stays where it is."""
    rbm = RBM(5, 3)
    with torch.no_grad():
        rbm.weight.fill_(strength)
        rbm.b.fill_(-strength * 3 / 2)
        rbm.c.fill_(-strength * 5 / 2)
    return rbm


def tempered(rbm):
    """Chains of four temperatures after so many sweeps that they have settled."""
    return run(rbm, ParallelTempering(k=17, n_chains=N_CHAINS, n_temperatures=4, adaptation=0.0), 1).state


def p_values(state, of):
    """Of the chains at each temperature against the distribution of ``of`` there."""
    return [
        chi_square_p_value(state_counts(v), visible_probabilities(of, float(beta)))
        for v, beta in zip(state.x, betas(state.gap), strict=True)
    ]


def test_every_temperature_has_its_distribution_and_the_coldest_not_that_of_a_mutant():
    rbm = small_rbm(5, 3, std=1.0)
    state = tempered(rbm)
    assert min(p_values(state, rbm)) > LEVEL
    for name, mutation in MUTANTS.items():
        assert p_values(state, changed(rbm, mutation))[0] < LEVEL, name


def test_exchanges_that_ignore_the_energies_are_seen(monkeypatch):
    """The test of the distribution rejects exchanges that are always made."""
    rbm = small_rbm(5, 3, std=1.0)
    monkeypatch.setattr(RBM, "tempered_energy", lambda self, v, h: torch.zeros(v.shape[:-1]))
    assert p_values(tempered(rbm), rbm)[0] < LEVEL


def test_exchanges_cross_a_barrier_that_sweeps_do_not():
    rbm = two_valleys()
    share = {}
    for name, sampler in (
        ("tempering", ParallelTempering(k=50, n_chains=499, n_temperatures=8)),
        ("sweeps", PCD(k=50, n_chains=499)),
    ):
        generator = rng.stream(1, "negative_phase")
        state = sampler.init(rbm, 1, generator=generator)
        state = state._replace(x=torch.ones_like(state.x))
        positive = positive_phase(rbm, torch.zeros(1, 5))
        for _ in range(6):
            negative = sampler.sample(rbm, state, positive, generator=generator)
            state = negative.state
        share[name] = float(negative.configurations.v.mean())
    assert share["sweeps"] > 0.99
    assert abs(share["tempering"] - 0.5) < 5 * 0.5 / 499**0.5


def test_gaps_follow_the_rate_of_exchange():
    rbm = small_rbm(7, 5, replicas=(2,), std=4.0)
    sampler = ParallelTempering(k=200, n_chains=97, n_temperatures=5, target_swap_rate=0.7)
    start = run(rbm, ParallelTempering(k=1, n_chains=97, n_temperatures=5, adaptation=0.0), 100)
    assert (start.info["swap_rate"] - 0.7).abs().max() > 0.1
    found = run(rbm, sampler, 3)
    assert (found.info["swap_rate"] - 0.7).abs().max() < 0.06
    assert (found.info["swap_rate_lowest"] > 0.6).all()
    assert betas(found.state.gap).shape == (2, 5)
    assert (betas(found.state.gap).diff() < 0).all()
    assert found.info["beta_hottest"].equal(betas(found.state.gap).amin(-1))


def test_an_easy_model_is_tempered_to_infinite_temperature_and_no_further():
    found = run(small_rbm(7, 5, std=0.01), ParallelTempering(k=300, n_chains=11, n_temperatures=3), 1)
    assert found.info["beta_hottest"] == 0


def test_round_trips_are_counted_by_the_states_that_make_them():
    """Without couplings and biases all exchanges are made: a state moves one step a round."""
    rbm = RBM(3, 2)
    with torch.no_grad():
        for parameter in rbm.parameters():
            parameter.zero_()
    sampler = ParallelTempering(k=1, n_chains=7, n_temperatures=4, adaptation=0.0)
    # The state that comes to the top in round 0 rests there in 1, goes down in 2 to 4, rests in 5, comes up in 6
    # to 8; another one follows every two rounds.
    trips = {n: float(run(rbm, sampler, n).info["round_trips"]) for n in (8, 9, 11, 17)}
    assert trips == {8: 0, 9: 7, 11: 14, 17: 35}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_temperatures": 1}, "n_temperatures = 1"),
        ({"target_swap_rate": 1.0}, r"target_swap_rate = 1\.0"),
        ({"adaptation": -0.1}, r"adaptation = -0\.1"),
        ({"k": 0}, "k = 0"),
        ({"n_chains": 0}, "n_chains = 0"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(SettingError, match=message):
        ParallelTempering(**settings)
