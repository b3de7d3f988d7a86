"""Annealing of machines of any connectivity against the enumerated log Z, over fixed seeds."""

from functools import partial

import pytest
import torch
from scipy import stats

from memcomp_lightning import rng
from memcomp_lightning.likelihood import (
    Ais,
    ReverseAis,
    ais,
    annealing_products,
    estimate_both_ways,
    log_likelihood_or_bound,
    log_partition_function,
    machine_ais,
)
from memcomp_lightning.models import BoltzmannMachine, Normal, one_by_one
from memcomp_lightning.models.connectivity import full, semi_restricted
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Spin
from memcomp_lightning.testing import small_dbm, small_rbm
from memcomp_lightning.testing.enumerated import enumerated

N_REPEATS = 101
RING = [(0, 1), (1, 2), (2, 3), (3, 4), (0, 4), (0, 5), (2, 5), (3, 6), (5, 6)]
"""Five units in a ring, which takes three classes, and two hidden ones that are coupled."""


def machine(visible, hidden, pairs, replicas=(), std=0.8):
    """With the same parameters in each replica."""
    one = BoltzmannMachine(
        visible=visible,
        hidden=hidden,
        connectivity=pairs,
        weight_init=Normal(std=std),
        generator=rng.stream(0, "machine"),
    )
    many = BoltzmannMachine(visible=visible, hidden=hidden, connectivity=pairs, replicas=replicas)
    with torch.no_grad():
        one.b.copy_(torch.linspace(-0.9, 0.6, one.n_visible))
        one.c.copy_(torch.linspace(0.5, -0.4, one.n_hidden))
        for each, alone in zip(many.parameters(), one.parameters(), strict=True):
            each.copy_(alone)
    return many


MACHINES = {
    "semi-restricted": partial(machine, Bernoulli(5), Bernoulli(4), semi_restricted(5, 4)),
    "all spins": partial(machine, Spin(4), Spin(3), None, std=0.5),
    "ring": partial(machine, Bernoulli(5), Bernoulli(2), RING, std=1.3),
    "categories": partial(machine, Categorical([2, 3]), Bernoulli(3), full(5)[1:]),
    "strong": partial(machine, Bernoulli(5), Bernoulli(4), semi_restricted(5, 4), std=2.5),
}
KINDS = pytest.mark.parametrize("kind", list(MACHINES)[:4])
DIRECTIONS = pytest.mark.parametrize("direction", ["up", "down"])


def base_for(model):
    return torch.linspace(0.7, -0.5, model.n_visible)


def samples(kind, n):
    """Exact ones, (N_REPEATS, n, n_units)."""
    states = enumerated(MACHINES[kind]())
    at = torch.multinomial(states.probability, N_REPEATS * n, replacement=True, generator=rng.stream(2, "samples"))
    return states.x[at].reshape(N_REPEATS, n, -1)


def estimate(kind, direction, *, base=True, n_chains=31, **settings):
    """Of every replica, from samples of the model where it goes down."""
    model, generator = MACHINES[kind](replicas=(N_REPEATS,)), rng.stream(1, "annealing")
    start = base_for(model) if base else None
    if direction == "up":
        return model, Ais(n_chains=n_chains, **settings).estimate(model, generator=generator, base=start)
    x = samples(kind, n_chains)
    return model, ReverseAis(**settings).estimate(model, x, generator=generator, base=start)


def unbiased_p_value(model, answer, direction):
    """Whether the mean weight, over all chains, is the exact ratio: a t test of w over that ratio."""
    of_base = machine_ais.MachinePath(model, ais._base(model, base_for(model))).log_z_of_base()
    sign = 1 if direction == "up" else -1
    ratio = torch.exp(answer.log_weights - sign * (log_partition_function(model) - of_base).unsqueeze(-1))
    return float(stats.ttest_1samp(ratio.flatten().numpy(), 1.0).pvalue)


@KINDS
@DIRECTIONS
@pytest.mark.parametrize("k", [1, 2])
def test_mean_weight_is_the_ratio_of_partition_functions(kind, direction, k):
    """Without bias at any number of temperatures, here few."""
    model, answer = estimate(kind, direction, n_betas=4, k=k, n_chains=97)
    assert unbiased_p_value(model, answer, direction) > 1e-5


def the_summed_class_drawn_last(monkeypatch):
    true = machine_ais.in_runs
    monkeypatch.setattr(machine_ais, "in_runs", lambda blocks: true([*blocks[1:], blocks[0]]))


def no_base_in_the_sweeps(monkeypatch):
    for kind in (one_by_one.Block, one_by_one.OneByOne):
        true = kind.draw

        def without(self, x, beta, base, *, generator, true=true):
            true(self, x, beta, None, generator=generator)

        monkeypatch.setattr(kind, "draw", without)


def sweeps_at_the_temperature_before(monkeypatch):
    for kind in (one_by_one.Block, one_by_one.OneByOne):
        true = kind.draw

        def colder(self, x, beta, base, *, generator, true=true):
            true(self, x, 0.7 * beta, base, generator=generator)

        monkeypatch.setattr(kind, "draw", colder)


def no_base_in_the_weights(monkeypatch):
    true = machine_ais.MachinePath._gain

    def without(self, x, beta, target):
        return true(self, x, beta, target) + 0.5 * (target - beta) * (x * self._base.unsqueeze(-2)).sum(-1)

    monkeypatch.setattr(machine_ais.MachinePath, "_gain", without)


MUTANTS = [
    no_base_in_the_sweeps,
    sweeps_at_the_temperature_before,
    no_base_in_the_weights,
]


@DIRECTIONS
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.__name__)
def test_mutants_are_seen(direction, mutant, monkeypatch):
    mutant(monkeypatch)
    model, answer = estimate("semi-restricted", direction, n_betas=4, n_chains=397)
    assert unbiased_p_value(model, answer, direction) < 1e-6


def test_the_class_that_is_summed_must_be_drawn_first(monkeypatch):
    """Drawn last, it stems from the temperature before; that shows where couplings are strong."""
    model, answer = estimate("strong", "up", n_betas=2, n_chains=397)
    assert unbiased_p_value(model, answer, "up") > 1e-3
    the_summed_class_drawn_last(monkeypatch)
    assert unbiased_p_value(model, estimate("strong", "up", n_betas=2, n_chains=397)[1], "up") < 1e-6


@KINDS
@DIRECTIONS
def test_estimates_lie_within_their_standard_errors(kind, direction):
    model, answer = estimate(kind, direction, base=False, n_betas=60, n_chains=51)
    z = (answer.log_z - log_partition_function(model)) / answer.standard_error
    assert z.abs().max() < 5
    assert 0.5 < (z.abs() < 1).double().mean() < 0.85
    assert 0.8 < answer.log_z.std() / answer.standard_error.mean() < 1.25


def test_replicas_dtypes_and_shapes():
    model = MACHINES["semi-restricted"](replicas=(2, 3))
    answer = Ais(n_chains=211, n_betas=50).estimate(model, generator=rng.stream(0, "ais"))
    assert answer.log_z.shape == (2, 3)
    assert answer.log_weights.shape == (2, 3, 211)
    assert all(part.dtype == torch.float64 and not part.requires_grad for part in answer)
    assert bool(((answer.log_z - log_partition_function(model)).abs() < 4 * answer.standard_error).all())
    with pytest.raises(ValueError, match=r"shape of v = \(2, 3, 9, 5\) is not allowed: expected \(2, 3, 'n', 9\)"):
        ReverseAis().estimate(model, torch.zeros(2, 3, 9, 5), generator=rng.stream(0, "ais"))


def test_real_units_keep_their_precision():
    model = machine(Gaussian(2, variance=0.6), Bernoulli(3), [(0, 2), (0, 3), (1, 4), (2, 3), (3, 4)])
    answer = Ais(n_chains=500, n_betas=50).estimate(model, generator=rng.stream(0, "ais"), base=base_for(model))
    assert abs(float(answer.log_z - log_partition_function(model))) < 4 * float(answer.standard_error) < 0.1


ANY = {
    "RBM": small_rbm,
    "DBM": small_dbm,
    "semi-restricted": MACHINES["semi-restricted"],
}


@pytest.mark.parametrize("make", ANY.values(), ids=ANY)
@pytest.mark.parametrize("replicas", [(), (3,)], ids=str)
def test_both_ways_agree_with_enumeration(make, replicas):
    model = make(replicas=replicas)
    v = rng.bernoulli(torch.full((17, model.n_visible), 0.4), generator=rng.stream(0, "rows"))
    both = estimate_both_ways(model, v, n_chains=150, n_betas=50, n_sweeps=20)
    true = log_partition_function(model)
    for answer in both:
        assert answer.log_weights.shape == (*replicas, 150)
        assert bool(((answer.log_z - true).abs() < 4 * answer.standard_error).all())
    assert both.log_z.equal(torch.maximum(both.up.log_z, both.down.log_z))
    assert both.gap.equal(both.up.log_z - both.down.log_z)
    assert bool(both.agree().all())
    assert not bool(both.agree(within=-1.0).any())
    larger = torch.where(both.gap > 0, both.up.standard_error, both.down.standard_error)
    assert both.standard_error.equal(larger)
    # Rows with the replica axis are the same rows, and the same seed gives the same numbers.
    again = estimate_both_ways(model, v.expand(*replicas, -1, -1), n_chains=150, n_betas=50, n_sweeps=20)
    assert again.up.log_weights.equal(both.up.log_weights)
    assert again.down.log_weights.equal(both.down.log_weights)


def test_chains_down_begin_at_the_rows():
    """Without sweeps the chains are the rows, whose weights fall together where these are all the same."""
    model = machine(Bernoulli(5), Bernoulli(0), full(5))
    row = torch.tensor([[1.0, 0.0, 1.0, 1.0, 0.0]])
    down = estimate_both_ways(model, row, n_chains=50, n_betas=1, n_sweeps=0).down
    assert float(down.log_weights.std()) == 0
    swept = estimate_both_ways(model, row, n_chains=50, n_betas=1, n_sweeps=5).down
    assert float(swept.log_weights.std()) > 0.1


def test_likelihoods_of_a_semi_restricted_machine_are_exact_with_many_hidden_units():
    model = machine(Bernoulli(5), Bernoulli(20), semi_restricted(5, 20), std=0.4)
    v = enumerated(machine(Bernoulli(5), Bernoulli(0), full(5))).x
    log_p = log_likelihood_or_bound(model, v, log_partition_function(model))
    assert float(log_p.logsumexp(-1)) == pytest.approx(0.0, abs=1e-10)


def test_products_count_classes_that_take_a_step_each():
    model = MACHINES["semi-restricted"](replicas=(7,))
    n_pairs, n_classes = 5 * 4 // 2 + 5 * 4, 6
    assert annealing_products(model, 10, 3) == 3 * 10 * 3 * n_pairs * 7 + ais.STEP * 3 * n_classes
    assert annealing_products(small_rbm(replicas=(7,)), 10, 3) == 10 * 3 * 7 * 5 * 7
