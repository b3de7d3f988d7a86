"""Mode-assisted updates: what they follow, how often, and whose state they move."""

import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import (
    PCD,
    GroundState,
    ModeAssisted,
    ModeSchedule,
    positive_phase,
    tensors_of,
    with_tensors,
)
from memcomp_lightning.samplers.mode_assisted import mode_scale
from memcomp_lightning.solvers import BruteForce
from memcomp_lightning.testing.conformance import small_rbm
from memcomp_lightning.types import Configurations

MODE = GroundState(solver=BruteForce())


def assisted(p_max, n_updates=1):
    schedule = ModeSchedule(n_updates=n_updates, p_max=p_max, delay=-1e3)
    return ModeAssisted(inner=PCD(n_chains=3), mode=MODE, schedule=schedule)


def data(rbm, n=11):
    v = rng.uniform((*rbm.replicas, n, rbm.n_visible), generator=rng.stream(1, "data")).double()
    return positive_phase(rbm, v)


def sample(sampler, rbm, state=None, generator=None):
    generator = rng.stream(0, "negative_phase") if generator is None else generator
    state = sampler.init(rbm, 1, generator=generator) if state is None else state
    return sampler.sample(rbm, state, data(rbm), generator=generator)


def ground_state(rbm):
    x = binary_states(rbm.n_visible + rbm.n_hidden, like=rbm.weight)
    x = x.expand(*rbm.replicas, *x.shape)
    energy = rbm.energy(x[..., : rbm.n_visible], x[..., rbm.n_visible :])
    return energy.amin(-1), energy


@pytest.mark.parametrize("replicas", [(), (3,), (2, 3)], ids=str)
def test_an_update_with_the_mode_follows_the_scaled_difference_of_energies(replicas):
    rbm = small_rbm(7, 5, replicas=replicas, std=6.0).double()
    found = sample(assisted(1.0), rbm)
    positive = data(rbm)
    lowest, energy = ground_state(rbm)
    # The scale as the published codes write it.
    sums = rbm.b.sum(-1) / 2 + rbm.c.sum(-1) / 2 + rbm.weight.sum((-1, -2)) / 4
    scale = ((-lowest - sums) / (4 * 8 * 6)).clamp(0, 1)
    assert (scale > 0.05).all()
    torch.testing.assert_close(-sums, energy.mean(-1))
    torch.testing.assert_close(found.info["mode_scale"], scale, rtol=1e-6, atol=0)
    gap = contrast(rbm, positive, found.configurations)
    expected = scale * (rbm.mean_energy(positive) - lowest)
    torch.testing.assert_close(gap, expected, rtol=1e-6, atol=1e-9)


def test_scale_stays_between_0_and_1():
    rbm = small_rbm(7, 5, std=300.0).double()
    mode = MODE.sample(rbm, (), data(rbm), generator=rng.stream(0, "unused")).configurations
    assert mode_scale(rbm, mode) == 1
    highest = Configurations(1 - mode.v, 1 - mode.h)
    rbm = small_rbm(7, 5, std=0.1).double()
    with torch.no_grad():
        rbm.b.fill_(-1.0)
        rbm.c.fill_(-1.0)
    everything = highest._replace(v=torch.ones_like(mode.v), h=torch.ones_like(mode.h))
    assert mode_scale(rbm, everything) == 0


def test_schedule_is_the_published_one():
    schedule = ModeSchedule(n_updates=200)
    for n_done in (0, 13, 60, 199):
        assert schedule.probability(n_done) == pytest.approx(0.1 / (1 + math.exp(6 - 20 * n_done / 200)))
    assert schedule.probability(10_000) == schedule.probability(200)
    with pytest.raises(SettingError, match="n_updates = 0"):
        ModeSchedule(n_updates=0)
    with pytest.raises(SettingError, match=r"p_max = 1\.5"):
        ModeSchedule(n_updates=1, p_max=1.5)


def test_the_mode_comes_as_often_as_scheduled():
    """A probability that rises from 0 to 0.6 half way: 120 of 400 updates, standard deviation below 7."""
    rbm, generator = small_rbm(3, 2).double(), rng.stream(0, "negative_phase")
    schedule = ModeSchedule(n_updates=400, p_max=0.6, steepness=2000.0, delay=1000.0)
    sampler = ModeAssisted(inner=PCD(n_chains=3), mode=MODE, schedule=schedule)
    state, used = sampler.init(rbm, 1, generator=generator), []
    for _ in range(400):
        found = sample(sampler, rbm, state, generator)
        state = found.state
        used.append("mode_scale" in found.info)
    assert not any(used[:198])
    assert abs(sum(used) - 120) < 30
    assert state.n_done == 400


def test_chains_of_the_inner_sampler_move_with_its_own_updates_alone():
    rbm = small_rbm(7, 5).double()
    generator = rng.stream(0, "negative_phase")
    start = assisted(0.0).init(rbm, 1, generator=generator)
    by_mode = sample(assisted(1.0), rbm, start, generator)
    assert by_mode.state.inner.x.equal(start.inner.x)
    by_chains = sample(assisted(0.0), rbm, start, generator)
    assert by_chains.state.inner.x.equal(by_chains.configurations.v)
    assert by_mode.state.n_done == by_chains.state.n_done == 1


def test_states_within_states_are_taken_apart_and_put_together():
    state = assisted(0.5).init(small_rbm(7, 5), 1, generator=rng.stream(0, "negative_phase"))
    tensors = tensors_of(state)
    assert set(tensors) == {"n_done", "inner.x"}
    again = with_tensors(state, {name: tensor + 1 for name, tensor in tensors.items()})
    assert type(again) is type(state)
    assert again.inner.x.equal(state.inner.x + 1)
    assert again.mode == state.mode
