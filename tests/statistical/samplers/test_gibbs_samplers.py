"""Distributions of the samplers against enumeration; each test rejects its mutants.

Independence comes from parallel chains: one sample a chain. A mutant is a sampler run on a wrong model;
``test_sample_count_suffices_for_the_mutant`` computes the power of the test against each of them, and the same
samples are held against the distribution of each.
"""

import copy

import pytest
import torch
from scipy import stats

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.models.chains import sweep
from memcomp_lightning.samplers import CD, PCD, Quench, positive_phase
from memcomp_lightning.testing import chi_square_p_value, state_counts
from memcomp_lightning.testing.conformance import small_rbm

N_CHAINS = 60_013
N_SWEEPS = 15
LEVEL = 1e-7
"""All tests of all samplers together reject a right one once in a million runs."""


def changed(rbm, change):
    mutant = copy.deepcopy(rbm)
    with torch.no_grad():
        change(mutant)
    return mutant


def hotter(rbm):
    for parameter in rbm.parameters():
        parameter *= 1.07


def swap_visible_bias(rbm):
    rbm.b.copy_(rbm.b.flip(-1))


def swap_hidden_bias(rbm):
    rbm.c.copy_(rbm.c.flip(-1))


MUTANTS = {"beta 1.07": hotter, "swapped b": swap_visible_bias, "swapped c": swap_hidden_bias}


def joint_probabilities(rbm, beta=1.0):
    """exp(-beta E) / Z over (v, h), from the terms of the energy."""
    x = binary_states(rbm.n_visible + rbm.n_hidden, like=torch.zeros((), dtype=torch.float64))
    v, h = x[:, : rbm.n_visible], x[:, rbm.n_visible :]
    w, b, c = (p.detach().double() for p in (rbm.weight, rbm.b, rbm.c))
    return torch.softmax(beta * (torch.einsum("ij,si,sj->s", w, h, v) + v @ b + h @ c), 0)


def visible_probabilities(rbm, beta=1.0):
    return joint_probabilities(rbm, beta).view(2**rbm.n_visible, -1).sum(-1)


def joint_counts(configurations, seed):
    """Counts of (v, h) with h drawn from its conditional means."""
    h = rng.bernoulli(configurations.h, generator=rng.stream(seed, "hidden"))
    return state_counts(torch.cat((configurations.v, h), -1))


def draw_cd(rbm, seed):
    generator = rng.stream(seed, "negative_phase")
    v = rbm.chains().random(N_CHAINS, generator=generator)
    sampler = CD(k=N_SWEEPS)
    state = sampler.init(rbm, N_CHAINS, generator=generator)
    return sampler.sample(rbm, state, positive_phase(rbm, v), generator=generator).configurations


def draw_pcd(rbm, seed):
    generator = rng.stream(seed, "negative_phase")
    sampler = PCD(k=3, n_chains=N_CHAINS)
    state = sampler.init(rbm, 2, generator=generator)
    positive = positive_phase(rbm, torch.zeros(2, rbm.n_visible))
    for _ in range(N_SWEEPS // 3):
        negative = sampler.sample(rbm, state, positive, generator=generator)
        state = negative.state
    return negative.configurations


SAMPLERS = {"CD": draw_cd, "PCD": draw_pcd}
MODELS = {"5 x 3": small_rbm(5, 3, std=1.0), "3 x 5": small_rbm(3, 5, std=1.0, seed=1)}
each_sampler = pytest.mark.parametrize("draw", SAMPLERS.values(), ids=SAMPLERS)
each_model = pytest.mark.parametrize("rbm", MODELS.values(), ids=MODELS)
each_mutant = pytest.mark.parametrize("mutation", MUTANTS.values(), ids=MUTANTS)


@each_model
@each_mutant
def test_sample_count_suffices_for_the_mutant(rbm, mutation):
    right = joint_probabilities(rbm)
    wrong = joint_probabilities(changed(rbm, mutation))
    df = len(right) - 1
    for given, against in ((wrong, right), (right, wrong)):
        shift = N_CHAINS * float(((given - against).square() / against).sum())
        power = 1 - stats.ncx2.cdf(stats.chi2.ppf(1 - LEVEL, df), df, shift)
        assert power > 1 - 1e-6


@each_model
@each_sampler
def test_chains_have_the_boltzmann_distribution_and_not_that_of_a_mutant(draw, rbm):
    counts = joint_counts(draw(rbm, 0), 0)
    assert chi_square_p_value(counts, joint_probabilities(rbm)) > LEVEL
    for name, mutation in MUTANTS.items():
        assert chi_square_p_value(counts, joint_probabilities(changed(rbm, mutation))) < LEVEL, name


@each_sampler
def test_chains_of_the_nearest_mutant_do_not(draw):
    rbm = MODELS["5 x 3"]
    counts = joint_counts(draw(changed(rbm, hotter), 0), 0)
    assert chi_square_p_value(counts, joint_probabilities(rbm)) < LEVEL


def test_persistent_chains_mix_by_their_state_alone():
    """Two sweeps from a state given by hand: PCD without its state would start at random again."""
    rbm = small_rbm(5, 3, std=2.5)
    sampler = PCD(k=1, n_chains=N_CHAINS)
    state = sampler.init(rbm, 1, generator=rng.stream(0, "negative_phase"))
    state = state._replace(x=torch.ones_like(state.x))
    generator = rng.stream(0, "negative_phase")
    negative = sampler.sample(rbm, state, positive_phase(rbm, torch.zeros(2, 5)), generator=generator)
    negative = sampler.sample(rbm, negative.state, positive_phase(rbm, torch.zeros(2, 5)), generator=generator)
    kernel = transition_matrix(rbm)
    counts = state_counts(negative.configurations.v)
    assert chi_square_p_value(counts, (kernel @ kernel)[-1]) > LEVEL
    for mutant in (kernel[-1], (kernel @ kernel)[0], (kernel @ kernel).mean(0)):
        assert chi_square_p_value(counts, mutant) < LEVEL


@pytest.mark.parametrize("beta", [0.7, 1.0, 0.0])
def test_tempered_sweeps_have_the_tempered_distribution(beta):
    rbm = MODELS["5 x 3"]
    generator = rng.stream(0, "negative_phase")
    v = rbm.chains().random(N_CHAINS, generator=generator)
    for _ in range(N_SWEEPS):
        v = sweep(rbm, v, beta=beta, generator=generator)
    assert chi_square_p_value(state_counts(v), visible_probabilities(rbm, beta)) > LEVEL
    for mutant in (beta + 0.1, 0.0 if beta else 0.2):
        assert chi_square_p_value(state_counts(v), visible_probabilities(rbm, mutant)) < LEVEL


def test_each_replica_has_its_own_distribution():
    rbm = small_rbm(5, 3, replicas=(2,), std=1.0)
    configurations = draw_cd(rbm, 0)
    parts = []
    for replica in range(2):
        part = small_rbm(5, 3)
        part.load_state_dict({name: p[replica] for name, p in rbm.state_dict().items()})
        parts.append(part)
    for i, j in ((0, 0), (1, 1), (0, 1), (1, 0)):
        p_value = chi_square_p_value(state_counts(configurations.v[i]), visible_probabilities(parts[j]))
        assert (p_value > LEVEL) == (i == j)


# --- Quench -----------------------------------------------------------------------------------------------


def transition_matrix(rbm, beta=1.0):
    """K(v, v') = sum_h p(h | v) p(v' | h), from weights and biases."""
    w, b, c = (p.detach().double() for p in (rbm.weight, rbm.b, rbm.c))
    v, h = binary_states(rbm.n_visible, like=w), binary_states(rbm.n_hidden, like=w)
    energy = -(v @ w.mT @ h.mT)
    to_h = torch.softmax(-beta * (energy - h @ c), -1)
    to_v = torch.softmax(-beta * (energy - (v @ b)[:, None]).mT, -1)
    return to_h @ to_v


def quench_probabilities(rbm, betas):
    p = torch.full((2**rbm.n_visible,), 2.0**-rbm.n_visible, dtype=torch.float64)
    for beta in betas:
        p = p @ transition_matrix(rbm, beta)
    return p


@pytest.mark.parametrize("beta_hot", [0.1, 0.3])
def test_quench_is_one_hot_sweep_and_one_at_beta_1(beta_hot):
    rbm = small_rbm(5, 3, std=4.0)
    sampler = Quench(beta_hot=beta_hot, n_chains=N_CHAINS)
    negative = sampler.sample(
        rbm, (), positive_phase(rbm, torch.zeros(2, 5)), generator=rng.stream(0, "negative_phase")
    )
    counts = state_counts(negative.configurations.v)

    def p_value(model, betas):
        return chi_square_p_value(counts, quench_probabilities(model, betas))

    assert p_value(rbm, [beta_hot, 1.0]) > LEVEL
    for betas in ([1.0, beta_hot], [1.0], [1.0, 1.0], [beta_hot + 0.1, 1.0], [beta_hot, 1.05]):
        assert p_value(rbm, betas) < LEVEL
    assert p_value(changed(rbm, swap_visible_bias), [beta_hot, 1.0]) < LEVEL
    torch.testing.assert_close(negative.configurations.h, rbm.hidden_mean(negative.configurations.v))
