"""How chains begin, are judged, and what rows of them are worth."""

import math

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.samplers.parallel_tempering import betas
from memcomp_lightning.testing import small_rbm
from memcomp_lightning.trained import sample
from memcomp_lightning.trained.chains.measured import effective_share, measured
from memcomp_lightning.trained.chains.processes import HOT_ENOUGH, Gibbs, fitted
from memcomp_lightning.trained.chains.starts import overdispersed
from memcomp_lightning.trained.chains.target import Target
from memcomp_lightning.trained.chains.watch import Watch


@pytest.mark.parametrize(("time", "spacing", "n_draws"), [(1.0, 1, 5), (9.0, 1, 7), (9.0, 4, 100), (30.0, 60, 3)])
def test_what_a_draw_is_worth(time, spacing, n_draws):
    """Of correlations phi^t the integrated time is (1 + phi) / (1 - phi), and their sum the variance of a mean."""
    phi = (time - 1) / (time + 1)
    lags = np.abs(np.subtract.outer(np.arange(n_draws), np.arange(n_draws))) * spacing
    variance_of_mean = (phi**lags).mean()
    assert effective_share(time, spacing, n_draws) * n_draws == pytest.approx(1 / variance_of_mean)
    assert effective_share(time, spacing, 1) == 1


def test_a_third_of_the_starts_is_of_each_kind():
    rbm = RBM(30, 20, weight_init=Normal(std=3.0))
    n = 300
    x = overdispersed(rbm, rbm.chains(), n, generator=rng.stream(0, "starts"))
    random, cooled, patterns = (x[kind::3] for kind in range(3))
    assert random.mean(0).sub(0.5).abs().max() < 0.3
    energy = [rbm.free_energy(kind).detach().mean() for kind in (random, cooled, patterns)]
    assert energy[1] < energy[0] - 10
    assert energy[2] < energy[0] - 10
    few = RBM(30, 20)
    with torch.no_grad():
        few.weight.fill_(1.0)
    active = overdispersed(few, few.chains(), n, generator=rng.stream(0, "starts"))[2::3].mean(-1)
    assert active.min() < 0.8
    assert active.max() == 1


def test_known_values_stand_in_every_state():
    rbm = small_rbm(6, 4)
    v, known = torch.ones(2, 6), torch.zeros(2, 6, dtype=torch.bool)
    known[0, :3] = known[1, 4] = True
    chains = Target(rbm, v, known).chains(5)
    stream = rng.stream(0, "starts")
    x = overdispersed(rbm, chains, 10, generator=stream)
    for _ in range(3):
        x = chains.sweep(x, generator=stream)
        assert (x[:5, :3] == 1).all()
        assert (x[5:, 4] == 1).all()
    assert (x[5:, :3] == 0).any()
    assert (chains.read(x).v[:5, :3] == 1).all()


@pytest.mark.parametrize("std", [0.1, 3.0])
def test_a_ladder_reaches_from_the_model_to_great_heat(std):
    rbm, stream = small_rbm(12, 9, std=std), rng.stream(0, "ladder")
    chains = rbm.chains()
    with torch.no_grad():
        process, state, _ = fitted(chains, chains.random(16, generator=stream), generator=stream)
        for _ in range(200):
            state = process.advance(state, generator=stream)
    beta = betas(state.gap)
    assert beta[0] == 1
    assert beta[-1] <= HOT_ENOUGH
    assert (beta == 0).sum() <= 1
    assert len(beta) == process.n_temperatures
    assert (state.gap == process.gap).all()  # it is fitted no more
    assert state.swap_rate.min() > 0.3
    assert process.renewals(state) > 2


class Still(Gibbs):
    """Chains of which none ever forgot anything."""

    def renewals(self, state):
        return 0.0


def test_chains_that_agree_but_were_never_renewed_are_not_trusted():
    rbm, stream = small_rbm(5, 3, std=0.1), rng.stream(0, "chains")
    chains = rbm.chains()
    with torch.no_grad():
        x = chains.random(32, generator=stream)
        watch = Watch.of(rbm, x.unsqueeze(0), 32)
        settings = {"n_chains_of_row": 32, "most_sweeps": 256, "generator": stream}
        for process, mixed in ((Gibbs(chains), True), (Still(chains), False)):
            found = measured(process, x, watch, **settings)
            assert found.r_hat < 1.05
            assert found.mixed == mixed


def test_weights_that_are_not_finite_are_refused():
    rbm = RBM(20, 20)
    with torch.no_grad():
        rbm.weight[0, 0] = math.nan
    with pytest.raises(ValueError, match="weight"):
        sample(rbm, 1)
