"""The statistical checks themselves."""

import pytest
import torch
from scipy import stats

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.testing import chi_square_p_value, state_counts

PROBABILITIES = torch.tensor([0.37, 0.29, 0.17, 0.11, 0.06])


def draw(n, seed, probabilities=PROBABILITIES):
    u = rng.uniform((n,), generator=rng.stream(seed, "test draws"))
    return torch.bincount(torch.bucketize(u, probabilities.cumsum(0)[:-1]), minlength=len(probabilities))


def test_states_are_counted_with_the_first_unit_as_the_highest_bit():
    states = binary_states(5, like=torch.zeros(()))
    counts = torch.arange(32) % 7
    assert state_counts(states.repeat_interleave(counts, 0)).equal(counts)


def test_p_value_of_a_known_table():
    counts, probabilities = torch.tensor([44, 56]), torch.tensor([0.5, 0.5])
    assert chi_square_p_value(counts, probabilities) == pytest.approx(stats.chi2.sf(1.44, 1))


def test_p_values_of_right_samples_are_uniform():
    p_values = [chi_square_p_value(draw(20_011, seed), PROBABILITIES) for seed in range(211)]
    assert stats.kstest(p_values, "uniform").pvalue > 1e-7
    shifted = PROBABILITIES + torch.tensor([0.01, -0.01, 0, 0, 0])
    p_values = [chi_square_p_value(draw(20_011, seed), shifted) for seed in range(211)]
    assert stats.kstest(p_values, "uniform").pvalue < 1e-6


def test_rare_states_are_pooled():
    rare = torch.tensor([1e-5, 2e-5, 3e-5])
    counts = torch.tensor([5000, 5000, 1, 0, 0])
    probabilities = torch.cat((torch.tensor([0.5, 0.5]), rare))
    pooled = chi_square_p_value(torch.tensor([5000, 5000, 1]), torch.tensor([0.5, 0.5, 6e-5]))
    assert chi_square_p_value(counts, probabilities) == pytest.approx(pooled, rel=1e-3)
    assert chi_square_p_value(torch.tensor([5000, 5000, 29, 0, 0]), probabilities) < 1e-6


def test_state_that_cannot_occur_has_p_value_zero():
    probabilities = torch.tensor([0.5, 0.5, 0.0])
    assert chi_square_p_value(torch.tensor([5000, 5000, 1]), probabilities) == 0
    assert chi_square_p_value(torch.tensor([5000, 5000, 0]), probabilities) == pytest.approx(1)
