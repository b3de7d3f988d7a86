"""Rows that are drawn from models of all kinds, against all states of the model."""

import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.models import DBN, RBM, observed
from memcomp_lightning.models.conditioned import conditioned, tempered
from memcomp_lightning.models.units import Bernoulli
from memcomp_lightning.testing import (
    Enumerated,
    enumerated,
    most_errors_off,
    small_dbn,
    small_layers,
    small_machines,
    small_rbms,
)
from memcomp_lightning.trained import sample

MOST = 6.5
"""Standard errors: of the hundreds of moments of all tests one is further off once in a million runs."""
N = 4000
MODELS = {name: make for name, make in (small_rbms() | small_machines()).items() if "ReLU" not in name}
OF_CHAINS = [
    ("bits x spins", "gibbs"),
    ("ragged categories x bits", "gibbs"),
    ("mixed x categories", "gibbs"),
    ("DBM of categories", "gibbs"),
    ("real x spins", "tempering"),
]


def errors_off(model, v, *, given=None, known=None):
    """Largest error of a moment of values of the visible units, in standard errors."""
    n, exact = model.n_visible, enumerated(model, given, known)
    return most_errors_off(v, Enumerated(exact.x[:, :n], exact.variance[:n], exact.probability, exact.energy))


@pytest.mark.parametrize("name", MODELS)
def test_exact_draws(name):
    model = MODELS[name]()
    v, mixing = sample(model, N)
    assert (mixing.method, mixing.effective, mixing.warning) == ("exact", N, None)
    assert errors_off(model, model.visible.encode(v)) < MOST


@pytest.mark.parametrize(("name", "method"), OF_CHAINS)
def test_draws_of_chains(name, method):
    model = MODELS[name]()
    v, mixing = sample(model, N, method=method, n_chains=128 if method == "gibbs" else 512)
    assert mixing.warning is None
    assert mixing.effective > 0.9 * N
    # As if there were as many rows as these are worth.
    assert errors_off(model, model.visible.encode(v)) < MOST
    assert errors_off(tempered(model, 0.6), model.visible.encode(v)) > MOST


def some_known(model, n, seed=0):
    """Rows of the model, of which some sites are known."""
    v = sample(model, n, seed=seed).v
    known = rng.uniform(v.shape, generator=rng.stream(seed, "known")) < 0.4
    known[:, 0], known[:, -1] = True, False
    return Rows(v.masked_fill(~known, 0.0), torch.full((n,), -1), known)


def part(rows, at):
    return Rows(*(None if x is None else x[at : at + 1] for x in rows))


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("ragged categories x bits", "auto"),
        ("mixed x categories", "gibbs"),
        ("categories alone", "gibbs"),
    ],
)
def test_given_values_of_one_row(name, method):
    model = MODELS[name]()
    rows = some_known(model, 1)
    v, _ = sample(model, N, given=rows, method=method)
    assert v[:, rows.observed[0]].eq(rows.v[:, rows.observed[0]]).all()
    known = model.visible.over_sites(rows.observed[0])
    given = model.visible.encode(rows.v)[0]
    assert errors_off(model, model.visible.encode(v), given=given, known=known) < MOST
    assert errors_off(model, model.visible.encode(v)) > MOST


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("mixed x categories", "auto"),
        ("DBM of mixed units", "auto"),
        ("categories alone", "gibbs"),
        ("bits x spins", "tempering"),
    ],
)
def test_each_row_of_a_table_with_gaps_is_completed(name, method):
    model = MODELS[name]()
    rows = some_known(model, 20)
    rows = rows._replace(observed=rows.observed.clone())
    rows.observed[7] = True  # no gap
    n = 100
    v, mixing = sample(model, n, given=rows, method=method)
    assert mixing.warning is None
    assert mixing.n_drawn == 19 * n
    v = v.unflatten(0, (20, n))
    wide = rows.observed.unsqueeze(1).expand(v.shape)
    assert v[wide].eq(rows.v.unsqueeze(1).expand(v.shape)[wide]).all()
    squares = []
    for at in range(20):
        known = model.visible.over_sites(rows.observed[at])
        exact = enumerated(model, model.visible.encode(part(rows, at).v)[0], known)
        x, p = (
            exact.x[:, ~torch.cat((known, torch.ones(model.n_hidden, dtype=torch.bool)))].double(),
            exact.probability,
        )
        mean = p @ x
        variance = p @ (x - mean).square() + exact.variance[: model.n_visible][~known]
        found = model.visible.encode(v[at])[:, ~known].double().mean(0)
        squares.append(((found - mean).square() / (variance / n))[variance > 0.03])
    # Squares of standard errors of a hundred means.
    assert torch.cat(squares).mean() < 2


@pytest.mark.parametrize("name", ["bits x spins", "mixed x categories"])
def test_temperature_multiplies_the_energy_and_leaves_the_measure(name):
    model, beta = MODELS[name](), 0.5
    v, _ = sample(model, N, temperature=1 / beta)
    exact = enumerated(tempered(model, beta))
    if not model.visible.real:
        cold = enumerated(model)
        torch.testing.assert_close(exact.probability, torch.softmax(-beta * cold.energy.double(), dim=-1))
    else:
        torch.testing.assert_close(exact.variance, enumerated(model).variance)
    assert errors_off(tempered(model, beta), model.visible.encode(v)) < MOST
    assert errors_off(model, model.visible.encode(v)) > MOST


def test_the_conditioned_machine_has_the_energies_of_the_whole():
    model = MODELS["mixed x categories"]().double()
    rows = some_known(model, 1)
    known = model.visible.over_sites(rows.observed[0])
    v = model.visible.encode(rows.v)[0].double()
    rest = conditioned(model, v, known)
    states = model.visible.encode(sample(model, 9).v).double()
    free = rest.free_energy(states[:, ~known])
    whole = model.free_energy(torch.where(known, v, states))
    torch.testing.assert_close(free - free[0], whole - whole[0])


def test_a_deep_belief_network_is_drawn_from_the_top():
    dbn = small_dbn(small_layers()["mixed"])
    v, mixing = sample(dbn, 20_000)
    assert "top layer" in mixing.reason
    top = enumerated(dbn[1])
    # The distribution of the data: p(h1) of the top RBM times p(v | h1) of the lowest.
    h = top.x[:, : dbn[1].n_visible]
    field = dbn[0].visible_field(h)
    mean = (top.probability.unsqueeze(-1) * dbn[0].visible.mean(field)).sum(0)
    found = dbn[0].visible.encode(v).double()
    error = found.std(0) / len(v) ** 0.5 + 1e-9
    assert ((found.mean(0) - mean).abs() / error).max() < 5


def test_values_are_those_of_the_sites():
    model = MODELS["mixed x categories"]()
    v, _ = sample(model, 50)
    bits, category, real, spin, _ = v.unbind(-1)
    assert set(bits.tolist()) <= {0, 1}
    assert set(category.tolist()) <= {0, 1, 2}
    assert set(spin.tolist()) <= {-1, 1}
    assert len(real.unique()) == 50  # draws, no means


def test_the_seed_decides():
    model = MODELS["real x bits"]()
    for method in ("exact", "gibbs"):
        first, again, other = (sample(model, 20, method=method, n_chains=32, seed=seed).v for seed in (1, 1, 2))
        assert first.equal(again)
        assert not first.equal(other)


def of_one_pattern(n_visible, n_hidden, weight, log_odds, free):
    """An RBM whose hidden units all prefer one pattern, and the pattern.

    k bits as in the pattern have the probability C(n, k) exp(bias k + n_hidden A(c + weight k)) / Z, so that a sum
    over k gives the log odds of states that are nearer to the pattern than to its negative. ``free`` says which of
    bias and c is fitted to them; the other one makes the model symmetric, or is 0.
    """
    pattern = torch.arange(n_visible) % 3 > 0
    sign = 2 * pattern.float() - 1
    k = torch.arange(n_visible + 1, dtype=torch.float64)
    n = torch.tensor(float(n_visible), dtype=torch.float64)
    log_ways = torch.lgamma(n + 1) - torch.lgamma(k + 1) - torch.lgamma(n - k + 1)
    near = 2 * k > n
    low, high = -20.0 * n_hidden, 20.0 * n_hidden
    for _ in range(80):
        middle = (low + high) / 2
        bias, c = (middle, -weight * n_visible / 2) if free == "bias" else (0.0, middle)
        log_p = log_ways + bias * k + n_hidden * torch.nn.functional.softplus(c + weight * k)
        found = float(log_p[near].logsumexp(0) - log_p[~near].logsumexp(0))
        low, high = (middle, high) if found < log_odds else (low, middle)
    assert found == pytest.approx(log_odds, abs=1e-6)
    rbm = RBM(n_visible, n_hidden)
    with torch.no_grad():
        rbm.weight.copy_(weight * sign.expand(n_hidden, -1))
        rbm.b.copy_(bias * sign)
        rbm.c.fill_(c + weight * int((~pattern).sum()))
    return rbm, pattern


def share_near(pattern, v):
    return float(((v == pattern).double().mean(-1) > 0.5).double().mean())


def test_two_separated_modes_have_their_weights():
    """Gibbs chains stay where they began, and say so; the default has both weights."""
    share, log_odds = 0.7, math.log(0.7 / 0.3)
    rbm, pattern = of_one_pattern(21, 18, 0.4, log_odds, "bias")
    v, mixing = sample(rbm, 600, method="gibbs")
    assert "tempering" in mixing.warning
    assert mixing.effective <= 128
    assert abs(share_near(pattern, v) - share) > 0.1

    v, mixing = sample(rbm, 600)
    assert mixing.method == "tempering"
    assert mixing.warning is None
    assert "R-hat" in mixing.reason
    assert mixing.exchanges.round_trips > 2
    assert mixing.effective > 300
    assert abs(share_near(pattern, v) - share) < 3 * math.sqrt(share * (1 - share) / mixing.effective)
    symmetric, _ = of_one_pattern(21, 18, 0.4, 0.0, "bias")  # both modes have one free energy
    assert sample(symmetric, 1, method="gibbs").mixing.warning

    # The sum over k is right: enumeration, where there are few hidden units, agrees.
    v, mixing = sample(of_one_pattern(21, 8, 0.9, log_odds, "bias")[0], 4000)
    assert mixing.method == "exact"
    assert abs(share_near(pattern, v) - share) < 4 * math.sqrt(share * (1 - share) / 4000)


def test_a_narrow_mode_is_seen():
    """Half of all states are near one pattern: chains that begin at random do not find it, nor do cold ones."""
    rbm, pattern = of_one_pattern(42, 24, 0.5, 0.0, "c")
    for method in ("gibbs", "tempering"):
        v, mixing = sample(rbm, 100, method=method, n_chains=32, most_sweeps=256)
        assert 0 < share_near(pattern, v) < 1
        assert "how often a mode comes up" in mixing.warning
        assert mixing.effective <= 32


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n": 0}, "n = 0"),
        ({"temperature": 0.0}, "temperature = 0"),
        ({"temperature": math.inf}, "temperature = inf"),
        ({"method": "fast"}, "method = 'fast'"),
        ({"method": "exact"}, "method = 'exact'"),
        ({"n_chains": 8}, "n_chains = 8"),
        ({"most_sweeps": 100}, "most_sweeps = 100"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        sample(RBM(20, 20), **{"n": 1, **settings})


def test_models_that_cannot_be_drawn_from_say_why():
    with pytest.raises(ValueError, match="replicas of the model"):
        sample(RBM(3, 2, replicas=(2,)), 1)
    with pytest.raises(Exception, match="top layer"):
        sample(DBN(3, [2, 2]), 1, given=Rows(torch.zeros(1, 3), torch.zeros(1), torch.zeros(1, 3) == 1))
    with pytest.raises(Exception, match="names in a run"):
        sample(RBM(3, 2), 1, given={"age": 3})
    whole = Rows(torch.zeros(1, 3), torch.zeros(1), None)
    with pytest.raises(ValueError, match="given"):
        sample(RBM(visible=Bernoulli(3), n_hidden=2), 1, given=whole)


def test_clamped_rows_need_whole_sites():
    model = MODELS["ragged categories x bits"]()
    half = torch.zeros(1, model.n_visible, dtype=torch.bool)
    half[0, 0] = True
    with pytest.raises(ValueError, match="site 0"):
        observed.check_mask(model, torch.zeros(1, model.n_visible), half)
