"""Likelihoods against enumeration of the joint states, from weights and biases alone."""

import logging
import math
import re

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import (
    cpu,
    exact_samples,
    kl_divergence,
    log_likelihood,
    log_partition_function,
    log_pseudo_likelihood,
)
from memcomp_lightning.likelihood.layers import Layers, layers_of
from memcomp_lightning.likelihood.prefixes import prefix_log_weights
from memcomp_lightning.models import RBM
from memcomp_lightning.testing import chi_square_p_value, state_counts
from memcomp_lightning.testing.conformance import small_rbm

SIZES = pytest.mark.parametrize("sizes", [(7, 5), (5, 7)], ids=str)
REPLICAS = pytest.mark.parametrize("replicas", [(), (3,), (2, 3)], ids=str)
STDS = [1e-3, 1.0, 30.0, 1e3]


def doubles(rbm):
    return (parameter.detach().double() for parameter in (rbm.weight, rbm.b, rbm.c))


def joint_log_weights(rbm):
    """-E of every joint state, ``(*replicas, 2^n_visible, 2^n_hidden)``."""
    weight, b, c = doubles(rbm)
    v, h = binary_states(rbm.n_visible, like=weight), binary_states(rbm.n_hidden, like=weight)
    return torch.einsum("...ij,ri,sj->...sr", weight, h, v) + (b @ v.T)[..., :, None] + (c @ h.T)[..., None, :]


def log_z_of(rbm):
    return joint_log_weights(rbm).flatten(-2).logsumexp(-1)


def log_p(rbm):
    """Of every visible state, ``(*replicas, 2^n_visible)``."""
    weights = joint_log_weights(rbm)
    return weights.logsumexp(-1) - weights.flatten(-2).logsumexp(-1, keepdim=True)


def images(rbm, n=11, replicas=None):
    shape = (*(rbm.replicas if replicas is None else replicas), n, rbm.n_visible)
    return (rng.uniform(shape, generator=rng.stream(1, "data")) < 0.4).float()


def number_of(v):
    """Index of a visible state among all of them."""
    return (v.long() * 2 ** torch.arange(v.shape[-1] - 1, -1, -1)).sum(-1)


def assert_same(ours, true, tolerance=1e-12):
    assert ours.dtype == torch.float64
    torch.testing.assert_close(ours, true, rtol=tolerance, atol=tolerance)


# --- log Z ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("std", STDS)
@pytest.mark.parametrize("sizes", [(7, 5), (5, 7), (11, 3), (1, 1), (2, 1)], ids=str)
@REPLICAS
def test_log_partition_function_is_that_of_all_joint_states(sizes, replicas, std):
    rbm = small_rbm(*sizes, replicas=replicas, std=std)
    ours = log_partition_function(rbm)
    assert ours.shape == replicas
    assert_same(ours, log_z_of(rbm))
    assert_same(log_partition_function(rbm.double()), ours)


MUTANTS = {
    "visible bias": lambda rbm: rbm.b.mul_(1 + 1e-6),
    "hidden bias": lambda rbm: rbm.c.neg_(),
    "weight": lambda rbm: rbm.weight[0, 0].add_(1e-6),
}


@pytest.mark.parametrize("change", MUTANTS.values(), ids=MUTANTS)
@torch.no_grad()
def test_log_partition_function_sees_every_parameter(change):
    rbm = small_rbm().double()
    before = log_z_of(rbm)
    change(rbm)
    assert (log_partition_function(rbm) - before).abs() > 1e-9


@pytest.mark.parametrize("std", [*STDS, 100.0, 250.0])
@pytest.mark.parametrize("sizes", [(13, 11), (11, 13), (3, 17)], ids=str)
def test_kernel_and_reference_agree_on_every_prefix(sizes, std):
    """Fields of 1e2 to 1e3 take every way through the kernel: full packs, short ones, units beyond exp."""
    layers = layers_of(small_rbm(*sizes, replicas=(2,), std=std))
    for n_second in range(layers.n_enumerated + 1):
        true = prefix_log_weights(layers, n_second=n_second, compiled=False)
        ours = prefix_log_weights(layers, n_second=n_second, compiled=True)
        assert ours.shape == (2, 2 ** (layers.n_enumerated - n_second))
        assert_same(ours, true)


def test_the_kernel_does_not_mind_what_numpy_raises():
    layers = layers_of(small_rbm(11, 13, std=250.0))
    usual = prefix_log_weights(layers, n_second=3, compiled=True)
    with np.errstate(all="raise"):
        assert_same(prefix_log_weights(layers, n_second=3, compiled=True), usual)


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("block", [1, 7, 13, 10_000])
def test_blocks_need_not_divide_the_states(block, compiled):
    layers = layers_of(small_rbm(11, 7, replicas=(3,)))
    whole = prefix_log_weights(layers, n_second=2)
    assert_same(prefix_log_weights(layers, n_second=2, block=block, compiled=compiled), whole)


def test_threads_do_the_same(threads):
    layers = layers_of(small_rbm(13, 11, replicas=(3,)))
    with threads(1):
        alone = prefix_log_weights(layers, n_second=3, block=5)
    with threads(2):
        assert prefix_log_weights(layers, n_second=3, block=5).equal(alone)


@pytest.mark.parametrize("std", [0.1, 3.0, 30.0])
def test_packs_stay_in_range_and_hold_every_unit_once(std):
    prepared = cpu.prepare(layers_of(small_rbm(101, 11, std=std)).part(0), 3)
    weight, bias = prepared.small
    assert prepared.closes[-1]
    assert len(bias) == 8 * len(prepared.closes)
    used = np.isfinite(bias)
    assert used.sum() + len(prepared.large[1]) == 101
    assert (weight[~used] == 0).all()
    assert np.isfinite(np.exp(prepared.small[0].clip(0).sum(1) + bias)).all()


def test_fields_at_the_edge_of_exp():
    """One unit at +-700 exactly, others just beside."""
    for field in (700.0, math.nextafter(700.0, 800.0), -700.0, 709.9, 745.2, -745.2, -1e5, -11.0):
        for split in (0.0, field, field / 2, -field, -711.0, 711.0):
            weight = torch.full((1, 3, 9), 0.1, dtype=torch.float64)
            weight[0, 1, 0], weight[0, 1, -1] = split, field - split
            zeros = torch.zeros(1, 9, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
            layers = Layers(weight, *zeros, True)
            ours, true = (prefix_log_weights(layers, n_second=4, compiled=c) for c in (True, False))
            assert_same(ours, true)


def test_too_large_a_layer_is_refused_with_sizes_and_time(threads):
    message = (
        r"^size of the smaller layer = 29 is not allowed: expected at most max_units = 25 to enumerate a 784x29 "
        r"RBM\. All its states would take about 1\.4 minutes on 1 CPU threads: raise max_units \(at most 32\)"
    )
    for function in (log_partition_function, lambda rbm: kl_divergence(rbm, torch.zeros(2, 784))):
        with pytest.raises(SettingError, match=message), threads(1):
            function(RBM(784, 29))
    with pytest.raises(SettingError, match=r"size of the smaller layer = 5 .* about 4e-08 seconds"), threads(1):
        log_partition_function(small_rbm(), max_units=4)
    with pytest.raises(SettingError, match=r"about 3\.7e\+286 years"), threads(1):
        log_partition_function(RBM(1103, 1101))
    for wrong in (0, 33, 2.5):
        with pytest.raises(SettingError, match=f"^max_units = {wrong} is not allowed: expected an integer"):
            log_partition_function(small_rbm(), max_units=wrong)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_diverged_parameters_are_refused(value):
    rbm = small_rbm()
    with torch.no_grad():
        rbm.c[0] = value
    with pytest.raises(SettingError, match=r"^c = 'not finite' is not allowed"):
        log_partition_function(rbm)


def test_progress_logs_an_estimate_and_shows_a_bar(caplog, capsys):
    rbm = small_rbm(11, 10)
    with caplog.at_level(logging.INFO):
        quiet = log_partition_function(rbm)
        assert not caplog.messages
        assert log_partition_function(rbm, progress=True).equal(quiet)
    assert re.fullmatch(r"Enumeration of 1 blocks: about 0 s on \d+ threads", caplog.messages[0])
    assert "enumeration: 100%" in capsys.readouterr().err


# --- likelihoods ------------------------------------------------------------------------------------------


@SIZES
@REPLICAS
def test_log_likelihood_is_that_of_the_enumerated_model(sizes, replicas):
    rbm = small_rbm(*sizes, replicas=replicas)
    log_z = log_partition_function(rbm)
    v = images(rbm)
    assert_same(log_likelihood(rbm, v, log_z), log_p(rbm).gather(-1, number_of(v)))
    every = binary_states(rbm.n_visible, like=rbm.b)
    assert_same(log_likelihood(rbm, every, log_z), log_p(rbm))
    assert_same(log_likelihood(rbm, every, log_z).exp().sum(-1), torch.ones(replicas, dtype=torch.float64))


@SIZES
@REPLICAS
@pytest.mark.parametrize("shared", [True, False])
def test_kl_divergence_counts_repeated_images(sizes, replicas, shared):
    rbm = small_rbm(*sizes, replicas=replicas)
    v = images(rbm, replicas=() if shared else replicas)
    v = torch.cat((v, v[..., :4, :], v[..., :1, :]), dim=-2)
    at = number_of(v).expand(*replicas, 16)
    counts = torch.zeros(*replicas, 2**rbm.n_visible, dtype=torch.float64)
    counts.scatter_add_(-1, at, torch.ones(at.shape, dtype=torch.float64))
    p = counts / 16
    true = torch.where(p > 0, p * (p.clamp(min=1e-300).log() - log_p(rbm)), 0.0).sum(-1)
    assert_same(kl_divergence(rbm, v), true)
    assert_same(kl_divergence(rbm, v, log_partition_function(rbm)), true)
    assert (true > 0).all()
    without_repeats = torch.where(p > 0, -math.log(16) / 16 - p * log_p(rbm), 0.0).sum(-1)
    assert ((true - without_repeats).abs() > 0.01).all()


def test_kl_divergence_of_a_model_from_itself_is_zero_and_finite_where_p_underflows():
    rbm = RBM(3, 2)
    with torch.no_grad():
        rbm.weight.zero_()
    assert_same(kl_divergence(rbm, binary_states(3, like=rbm.b)), torch.zeros((), dtype=torch.float64))
    with torch.no_grad():
        rbm.b.fill_(1e3)
    divergence = kl_divergence(rbm, torch.zeros(5, 3))
    assert_same(divergence, torch.tensor(3e3, dtype=torch.float64))


@SIZES
@REPLICAS
def test_pseudo_likelihood_is_the_conditional_probability_by_enumeration(sizes, replicas):
    rbm = small_rbm(*sizes, replicas=replicas)
    v = images(rbm)
    at, p = number_of(v), log_p(rbm)
    here = p.gather(-1, at)
    for unit in range(rbm.n_visible):
        flipped = p.gather(-1, at ^ 2 ** (rbm.n_visible - 1 - unit))
        assert_same(log_pseudo_likelihood(rbm, v)[..., unit], here - torch.logaddexp(here, flipped))
    shared = images(rbm, replicas=())
    assert_same(
        log_pseudo_likelihood(rbm, shared),
        log_pseudo_likelihood(rbm, shared.expand(*replicas, *shared.shape)),
    )


def test_chunks_of_rows_change_nothing(monkeypatch):
    rbm = small_rbm(replicas=(3,))
    v, log_z = images(rbm), log_partition_function(rbm)
    whole = log_likelihood(rbm, v, log_z), log_pseudo_likelihood(rbm, v)
    monkeypatch.setattr("memcomp_lightning.likelihood.layers.NUMBERS", 3 * 35 * 4)
    assert_same(log_likelihood(rbm, v, log_z), whole[0])
    assert_same(log_pseudo_likelihood(rbm, v), whole[1])


CALLS = {
    "log_likelihood": lambda rbm, v: log_likelihood(rbm, v, torch.zeros(rbm.replicas)),
    "kl_divergence": kl_divergence,
    "log_pseudo_likelihood": log_pseudo_likelihood,
}


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_grey_values_and_wrong_shapes_are_refused(call):
    rbm = small_rbm(replicas=(3,))
    v = images(rbm)
    v[1, 2, 3] = 0.25
    message = re.escape(
        "v in column 3, row 2 = 0.25 is not allowed: expected values in {0, 1}. Grey values have no likelihood"
    )
    with pytest.raises(SettingError, match=f"^{message}.*binarise"):
        call(rbm, v)
    for shape in ((11, 5), (2, 11, 7), (3, 2, 11, 7)):
        message = re.escape(f"shape of v = {shape} is not allowed: expected (n, 7), or with the replica axes (3,)")
        with pytest.raises(SettingError, match=f"^{message}"):
            call(rbm, torch.zeros(shape))


# --- samples ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [(3, 2), (2, 3), (3, 11)], ids=str)
def test_exact_samples_have_the_distribution_of_the_model(sizes, monkeypatch):
    rbm = small_rbm(*sizes, replicas=(2,), std=2.0)
    # A prefix and a rest, in chunks that do not divide the samples.
    monkeypatch.setattr("memcomp_lightning.likelihood.exact.N_SECOND", 1)
    monkeypatch.setattr("memcomp_lightning.likelihood.exact.NUMBERS", 50_000)
    v = exact_samples(rbm, 20_011, generator=rng.stream(0, "samples"))
    assert v.shape == (2, 20_011, rbm.n_visible)
    assert v.dtype == rbm.b.dtype
    p = log_p(rbm).exp()
    for replica in range(2):
        counts = state_counts(v[replica])
        assert chi_square_p_value(counts, p[replica]) > 1e-7
        assert chi_square_p_value(counts, p[1 - replica]) < 1e-7
        warmer = torch.softmax(0.9 * joint_log_weights(rbm)[replica].flatten(), 0).view(len(p[0]), -1).sum(-1)
        assert chi_square_p_value(counts, warmer) < 1e-7


def test_exact_samples_of_a_large_layer_below_a_small_one():
    rbm = small_rbm(97, 11, std=0.5)
    v = exact_samples(rbm, 5003, generator=rng.stream(0, "samples"))
    layers = layers_of(rbm)
    h = binary_states(11, like=layers.weight)
    p = torch.softmax(prefix_log_weights(layers, n_second=0)[0], 0)
    mean = p @ torch.sigmoid(h @ layers.weight[0].mT + layers.other[0])
    spread = (mean * (1 - mean) / 5003).sqrt()
    assert ((v.double().mean(0) - mean).abs() < 4.5 * spread).all()
    with pytest.raises(SettingError, match=r"^n = 0 is not allowed"):
        exact_samples(rbm, 0, generator=rng.stream(0, "samples"))
