"""Moments of the exact sampler: against enumeration, and against long parallel chains."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.samplers import CD, Exact, positive_phase
from memcomp_lightning.testing.conformance import small_rbm

SIZES = pytest.mark.parametrize("sizes", [(7, 5), (5, 7), (5, 5)], ids=str)


def exact(rbm):
    sampler = Exact()
    generator = rng.stream(0, "unused")
    state = sampler.init(rbm, 1, generator=generator)
    v_data = torch.zeros(*rbm.replicas, 1, rbm.n_visible, dtype=rbm.b.dtype)
    return sampler.sample(rbm, state, positive_phase(rbm, v_data), generator=generator).configurations


def moments(configurations):
    """<h v>, <v>, <h>."""
    v, h, weight = configurations
    share = torch.ones_like(v[..., 0]) if weight is None else weight
    share = (share / share.sum(-1, keepdim=True)).unsqueeze(-1)
    return (h * share).mT @ v, (v * share).sum(-2), (h * share).sum(-2)


@torch.no_grad()
def moments_by_enumeration(rbm, beta=1.0):
    x = binary_states(rbm.n_visible + rbm.n_hidden, like=rbm.b)
    v, h = x.split((rbm.n_visible, rbm.n_hidden), -1)
    energy = -torch.einsum("...ij,si,sj->...s", rbm.weight, h, v) - rbm.b @ v.T - rbm.c @ h.T
    p = torch.softmax(-beta * energy, -1)
    return torch.einsum("...s,si,sj->...ij", p, h, v), p @ v, p @ h


@SIZES
@pytest.mark.parametrize("replicas", [(), (3,), (2, 3)], ids=str)
def test_moments_are_those_of_all_states(sizes, replicas):
    rbm = small_rbm(*sizes, replicas=replicas).double()
    for ours, true in zip(moments(exact(rbm)), moments_by_enumeration(rbm), strict=True):
        torch.testing.assert_close(ours, true, rtol=0, atol=1e-14)


@SIZES
def test_weights_are_probabilities_of_the_smaller_layer(sizes):
    rbm = small_rbm(*sizes).double()
    v, _, weight = exact(rbm)
    assert len(weight) == len(v) == 2 ** min(sizes)
    torch.testing.assert_close(weight.sum(), torch.tensor(1.0).double())


def test_moments_agree_with_parallel_chains_and_a_mutant_does_not():
    rbm = small_rbm(7, 5).double()
    n = 40_009
    generator = rng.stream(0, "negative_phase")
    start = rbm.chains().random(n, generator=generator)
    chains = CD(k=31).sample(rbm, (), positive_phase(rbm, start), generator=generator).configurations
    second_moment = (chains.h**2).mT @ (chains.v**2) / n
    measured = moments(chains)[0]
    error = ((second_moment - measured**2) / n).sqrt()

    def largest_deviation(moment):
        return ((moment - measured).abs() / error).max()

    # 35 numbers: one in ten million is more than 6 standard errors off.
    assert largest_deviation(moments(exact(rbm))[0]) < 6
    assert largest_deviation(moments_by_enumeration(rbm, beta=1.1)[0]) > 6


def test_error_names_size_of_the_smaller_layer_and_the_limit():
    message = "units to enumerate = 5 is not allowed: expected at most max_units = 3"
    with pytest.raises(SettingError, match=message):
        Exact(max_units=3).init(small_rbm(7, 5), 1, generator=rng.stream(0, "unused"))
    Exact(max_units=5).init(small_rbm(7, 5), 1, generator=rng.stream(0, "unused"))
