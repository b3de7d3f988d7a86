"""Annealed importance sampling against the enumerated log Z, over fixed seeds."""

import re

import pytest
import torch
from scipy import stats

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import (
    Ais,
    AisEstimate,
    ReverseAis,
    ais,
    base_of,
    exact_samples,
    log_partition_function,
)
from memcomp_lightning.models import RBM
from memcomp_lightning.models.units import Bernoulli
from memcomp_lightning.testing.conformance import small_rbm

SIZES = pytest.mark.parametrize("sizes", [(7, 5), (5, 7)], ids=str)
N_REPEATS = 211
"""Replicas with the same parameters: independent repeats of an estimate."""


def repeated(rbm, n=N_REPEATS):
    """The same RBM n times side by side."""
    many = RBM(rbm.n_visible, rbm.n_hidden, replicas=(n,)).to(rbm.b)
    with torch.no_grad():
        for each, one in zip(many.parameters(), rbm.parameters(), strict=True):
            each.copy_(one)
    return many


def base_for(rbm):
    return torch.linspace(-0.7, 0.4, rbm.n_visible)


def estimate(direction, rbm, seed=0, base=None, n_chains=31, v=None, **settings):
    """Of every replica, from samples of the model where it goes down."""
    generator = rng.stream(seed, "annealing")
    if direction == "up":
        return Ais(n_chains=n_chains, **settings).estimate(rbm, generator=generator, base=base)
    v = exact_samples(rbm, n_chains, generator=generator) if v is None else v
    return ReverseAis(**settings).estimate(rbm, v, generator=generator, base=base)


def scores(answer, log_z):
    return (answer.log_z - log_z) / answer.standard_error


def unbiased_p_value(answer, rbm, base, direction):
    """Whether the mean weight, over all chains, is the exact ratio: a t test of w over that ratio."""
    log_z, of_base = log_partition_function(rbm), ais._log_z_of_base(rbm, ais._base(rbm, base))
    sign = 1 if direction == "up" else -1
    ratio = torch.exp(answer.log_weights - sign * (log_z - of_base).unsqueeze(-1)).flatten()
    return float(stats.ttest_1samp(ratio.numpy(), 1.0).pvalue)


DIRECTIONS = pytest.mark.parametrize("direction", ["up", "down"])


@SIZES
@DIRECTIONS
@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize("with_base", [True, False])
def test_mean_weight_is_the_ratio_of_partition_functions(direction, sizes, k, with_base):
    """Without bias at any number of temperatures, here few."""
    rbm = repeated(small_rbm(*sizes, std=1.3))
    base = base_for(rbm) if with_base else None
    answer = estimate(direction, rbm, base=base, n_betas=5, k=k)
    assert unbiased_p_value(answer, rbm, base, direction) > 1e-7


def wrong_base(monkeypatch):
    true = ais._log_z_of_base
    monkeypatch.setattr(ais, "_log_z_of_base", lambda model, base: true(model, base * 0))


def hidden_units_left_out(monkeypatch):
    monkeypatch.setattr(ais, "_log_z_of_base", lambda _, base: torch.nn.functional.softplus(base.double()).sum(-1))


def last_temperature_skipped(monkeypatch):
    """Or the first, on the way down."""
    true = ais._anneal

    def skipping(model, v, base, betas, *rest):
        return true(model, v, base, betas[:-1] if betas[-1] == 1 else betas[1:], *rest)

    monkeypatch.setattr(ais, "_anneal", skipping)


def sweeps_at_the_temperature_before(monkeypatch):
    """Chains in equilibrium with another distribution than that of their weights."""
    true = RBM.visible_field
    monkeypatch.setattr(RBM, "visible_field", lambda rbm, h: 0.8 * true(rbm, h))


def biases_exchanged(monkeypatch):
    true = ais._anneal
    monkeypatch.setattr(ais, "_anneal", lambda model, v, base, *rest: true(model, v, -base, *rest))


MUTANTS = [
    wrong_base,
    hidden_units_left_out,
    last_temperature_skipped,
    sweeps_at_the_temperature_before,
    biases_exchanged,
]


@DIRECTIONS
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.__name__)
def test_mutants_are_seen(direction, mutant, monkeypatch):
    rbm = repeated(small_rbm(std=1.3))
    base = base_for(rbm)
    log_z = log_partition_function(rbm)
    v = exact_samples(rbm, 31, generator=rng.stream(1, "samples"))
    right = estimate(direction, rbm, base=base, n_betas=53, v=v)
    assert abs(scores(right, log_z).mean()) < 1
    mutant(monkeypatch)
    wrong = estimate(direction, rbm, base=base, n_betas=53, v=v)
    assert stats.ttest_1samp((wrong.log_z - log_z).numpy(), float((right.log_z - log_z).mean())).pvalue < 1e-6
    assert abs(wrong.log_z.mean() - log_z[0]) > 5 * wrong.log_z.std() / N_REPEATS**0.5


@SIZES
@DIRECTIONS
@pytest.mark.parametrize("std", [0.8, 2.0])
def test_estimates_lie_within_their_standard_errors(direction, sizes, std):
    rbm = repeated(small_rbm(*sizes, std=std))
    answer = estimate(direction, rbm, n_chains=97, n_betas=101)
    z = scores(answer, log_partition_function(rbm))
    assert z.abs().max() < 5
    # The share within one and two standard errors: 0.68 and 0.95 for a normal law.
    assert 0.55 < (z.abs() < 1).double().mean() < 0.80
    assert 0.88 < (z.abs() < 2).double().mean() < 0.99
    assert 0.8 < answer.log_z.std() / answer.standard_error.mean() < 1.25


def test_log_weights_lie_below_upwards_and_above_downwards():
    """By Jensen's inequality, with a gap that closes as the steps get smaller."""
    rbm = repeated(small_rbm(std=1.5))
    log_z, of_base = log_partition_function(rbm), ais._log_z_of_base(rbm, torch.zeros_like(rbm.b))
    gaps = []
    for n_betas in (11, 101):
        up, down = (estimate(direction, rbm, n_betas=n_betas).log_weights for direction in ("up", "down"))
        below = log_z - (of_base + up.mean(-1))
        above = (of_base - down.mean(-1)) - log_z
        for gap in (below, above):
            assert stats.ttest_1samp(gap.numpy(), 0.0, alternative="greater").pvalue < 1e-6
        gaps.append((below.mean(), above.mean()))
    assert all(fine < 0.4 * coarse for coarse, fine in zip(*gaps, strict=True))


@DIRECTIONS
@pytest.mark.parametrize("replicas", [(), (3,), (2, 3)], ids=str)
def test_replicas_are_estimated_side_by_side(direction, replicas):
    rbm = small_rbm(replicas=replicas)
    for base in (None, base_for(rbm), base_for(rbm).expand(*replicas, 7)):
        answer = estimate(direction, rbm, base=base, n_chains=211, n_betas=101)
        assert answer.log_z.shape == answer.standard_error.shape == answer.effective_sample_size.shape == replicas
        assert answer.log_weights.shape == (*replicas, 211)
        assert all(part.dtype == torch.float64 for part in answer)
        assert not any(part.requires_grad for part in answer)
        assert (scores(answer, log_partition_function(rbm)).abs() < 4).all()


@DIRECTIONS
def test_settings_of_the_schedule(direction):
    rbm = small_rbm()
    same = [
        estimate(direction, rbm, n_betas=4),
        estimate(direction, rbm, betas=(0, 0.25, 0.5, 0.75, 1)),
        estimate(direction, rbm, betas=torch.linspace(0, 1, 5)),
    ]
    assert all(answer.log_weights.equal(same[0].log_weights) for answer in same)
    assert not estimate(direction, rbm, betas=[0, 0.1, 0.5, 0.75, 1]).log_weights.equal(same[0].log_weights)
    kind = Ais if direction == "up" else ReverseAis
    for betas in ([0, 0.5], [0.1, 1], [0, 0.6, 0.5, 1], [0, 0.5, 0.5, 1], [0], [], [0, float("nan"), 1]):
        with pytest.raises(SettingError, match=r"^betas = .* expected numbers that increase from 0 to 1"):
            kind(betas=betas)
    for setting in ("n_betas", "k"):
        with pytest.raises(SettingError, match=f"^{setting} = 0 is not allowed: expected an integer >= 1"):
            kind(**{setting: 0})
    with pytest.raises(SettingError, match=r"^n_chains = 1 is not allowed: expected an integer >= 2"):
        Ais(n_chains=1)


def test_shapes_are_refused():
    rbm = small_rbm(replicas=(3,))
    generator = rng.stream(0, "annealing")
    with pytest.raises(SettingError, match=r"^shape of base = \(5,\) is not allowed: expected \(7,\) or \(3, 7\)"):
        Ais().estimate(rbm, generator=generator, base=torch.zeros(5))
    for shape in ((11, 7), (3, 11, 5), (3, 1, 7)):
        message = re.escape(f"shape of v = {shape} is not allowed: expected (3, 'n', 7) with n >= 2")
        with pytest.raises(SettingError, match=f"^{message}"):
            ReverseAis().estimate(rbm, torch.zeros(shape), generator=generator)


@pytest.mark.parametrize(
    ("beta", "target"), [(0.0, 0.3), (0.3, 0.31), (0.99, 1.0), (0.0, 1.0), (0.7, 0.2), (1.0, 0.0)]
)
@pytest.mark.parametrize("size", [1e-6, 1.0, 30.0, 1e4])
def test_gain_of_softplus_loses_no_digits(beta, target, size):
    field = torch.empty(31, 503).normal_(generator=rng.stream(0, "fields")) * size
    x = field.double()
    zero = torch.zeros_like(x)
    true = torch.logaddexp(target * x, zero) - torch.logaddexp(beta * x, zero)
    ours = Bernoulli(field.shape[-1]).cumulant_gain(field, beta, target)
    scale = true.abs().sum(-1)
    assert ((ours - true.sum(-1)).abs() < 1e-6 * scale).all()
    torch.testing.assert_close(
        Bernoulli(x.shape[-1]).cumulant_gain(x, beta, target), true.sum(-1), rtol=1e-12, atol=1e-12
    )


def test_standard_error_and_effective_size_of_known_weights():
    log_w = torch.tensor([1.0, 2.0, 4.0, 1.0], dtype=torch.float64).log() + 1000
    up, down = (ais._summary(torch.tensor(7.0, dtype=torch.float64), log_w, sign) for sign in (1, -1))
    assert up.log_z.item() == pytest.approx(7 + 1000 + torch.tensor(2.0).log().item())
    assert down.log_z.item() == pytest.approx(7 - 1000 - torch.tensor(2.0).log().item())
    assert up.standard_error.item() == pytest.approx(2**0.5 / 2 / 2)
    assert up.effective_sample_size.item() == pytest.approx(64 / 22)
    assert str(up) == "log Z = 1007.6931 +- 0.35 (2.9 effective of 4 chains)"
    both = AisEstimate(*(torch.stack((x, y)) for x, y in zip(up, down, strict=True)))
    assert str(both).splitlines() == [str(up), str(down)]


def test_base_of_data_has_their_smoothed_means():
    v = (binary_states(3, like=torch.zeros(())) * torch.tensor([1.0, 0.0, 1.0])).expand(2, 8, 3)
    torch.testing.assert_close(torch.sigmoid(base_of(v)), torch.tensor([[0.5, 0.1, 0.5]]).expand(2, 3))


def test_base_of_the_data_brings_more_effective_chains():
    generator = rng.stream(0, "annealing")
    rbm = repeated(small_rbm(17, 5, std=0.8), 53)
    with torch.no_grad():
        rbm.b -= 2
    v = exact_samples(rbm, 101, generator=generator)
    settings = Ais(n_chains=31, n_betas=11)
    plain = settings.estimate(rbm, generator=generator).effective_sample_size.mean()
    assert settings.estimate(rbm, generator=generator, base=base_of(v)).effective_sample_size.mean() > 1.5 * plain


def test_progress_shows_a_bar_and_changes_nothing(capsys):
    rbm = small_rbm()
    quiet = Ais(n_chains=5, n_betas=7).estimate(rbm, generator=rng.stream(0, "annealing"))
    shown = Ais(n_chains=5, n_betas=7).estimate(rbm, generator=rng.stream(0, "annealing"), progress=True)
    assert quiet.log_weights.equal(shown.log_weights)
    assert "annealing: 100%" in capsys.readouterr().err
