"""One step of each scheme by hand, orders of accuracy, step control."""

import itertools
import math
from typing import NamedTuple

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.problems import Qubo
from memcomp_lightning.solvers.dmm import (
    AdaptiveEuler,
    BondField,
    ClauseField,
    DmmSolver,
    Heun,
    Splitting,
    Strang,
)

SCHEMES = [AdaptiveEuler, Splitting, Strang, Heun]


def normal(*shape, seed):
    return torch.empty(shape, dtype=torch.float64).normal_(generator=rng.stream(seed, "test draws"))


# --- one step by hand -------------------------------------------------------------------------------------


class Toy(NamedTuple):
    voltage: torch.Tensor
    short_term: torch.Tensor
    long_term: torch.Tensor


def voltage_rate(v, s, x):
    return 1.3 * s - 0.7 * x * v + 0.2


def short_rate(v, s, x):
    return 0.9 * (s + 0.5) * (v - 0.1)


def long_rate(v, s, x):
    return 2.0 * v * v - 0.6 * x + 0.3 * s


class ToyField:
    """One voltage, two memories, all of which feel each other; ``machine`` is the stability."""

    def stability(self, machine):
        return machine

    def derivative(self, machine, state):
        return Toy(voltage_rate(*state), short_rate(*state), long_rate(*state))

    def bound(self, machine, state):
        return Toy(state.voltage.clamp(-1, 1), state.short_term.clamp(0, 1), state.long_term.clamp(1, 3))


def clip(x, low, high):
    return min(max(x, low), high)


def bounded(v, s, x):
    return clip(v, -1, 1), clip(s, 0, 1), clip(x, 1, 3)


def euler(v, s, x, dt):
    state = (v, s, x)
    return bounded(v + dt * voltage_rate(*state), s + dt * short_rate(*state), x + dt * long_rate(*state))


def splitting(v, s, x, dt):
    v = clip(v + dt * voltage_rate(v, s, x), -1, 1)
    return bounded(v, s + dt * short_rate(v, s, x), x + dt * long_rate(v, s, x))


def strang(v, s, x, dt):
    _, s, x = bounded(v, s + dt / 2 * short_rate(v, s, x), x + dt / 2 * long_rate(v, s, x))
    v = clip(v + dt * voltage_rate(v, s, x), -1, 1)
    return bounded(v, s + dt / 2 * short_rate(v, s, x), x + dt / 2 * long_rate(v, s, x))


def heun(v, s, x, dt):
    here, there = (v, s, x), euler(v, s, x, dt)
    mean = [(rate(*here) + rate(*there)) / 2 for rate in (voltage_rate, short_rate, long_rate)]
    return bounded(*(a + dt * b for a, b in zip(here, mean, strict=True)))


BY_HAND = {
    AdaptiveEuler: euler,
    Splitting: splitting,
    Strang: strang,
    Heun: heun,
}
STATES = [
    (0.2, 0.7, 1.9),  # inside
    (-0.6, 0.4, 2.9),  # the long-term memory is decaying
    (0.9, 0.95, 1.1),  # reaches the upper bounds
    (-0.97, 0.02, 1.0),  # at the lower bounds
]


@pytest.mark.parametrize("scheme", SCHEMES)
def test_step_by_hand(scheme):
    control = {"change": 0.31, "dt_min": 0.2, "dt_max": 0.38}
    state = Toy(*torch.tensor(STATES, dtype=torch.float64).unsqueeze(-1).unbind(1))
    after, dt, _ = scheme(**control).step(ToyField(), torch.ones(1, dtype=torch.float64), state)
    sizes = [clip(0.31 / abs(voltage_rate(*row)), control["dt_min"], control["dt_max"]) for row in STATES]
    assert set(sizes) > {0.2, 0.38}
    torch.testing.assert_close(dt, torch.tensor(sizes, dtype=torch.float64))
    expected = [BY_HAND[scheme](*row, size) for row, size in zip(STATES, sizes, strict=True)]
    found = torch.cat(after, dim=-1)
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), rtol=1e-13, atol=1e-13)
    assert (found == 1).any()


@pytest.mark.parametrize("lag", [0.0, 0.3, 0.5])
def test_lag_mixes_in_the_rate_of_the_last_step(lag):
    scheme, machine = Splitting(change=0.31, dt_min=0.2, dt_max=0.38, lag=lag), torch.ones(1, dtype=torch.float64)
    rows = torch.tensor(STATES, dtype=torch.float64)
    state, expected, before = Toy(*rows.unsqueeze(-1).unbind(1)), STATES, [None] * len(STATES)
    rate = None
    for _ in range(3):
        state, dt, rate = scheme.step(ToyField(), machine, state, before=rate)
        moved = []
        for row, (v, s, x) in enumerate(expected):
            now = voltage_rate(v, s, x)
            mixed = now if before[row] is None else (1 - lag) * now + lag * before[row]
            size = clip(0.31 / abs(mixed), 0.2, 0.38)
            assert dt[row] == pytest.approx(size, rel=1e-12)
            assert rate[row] == pytest.approx(now, rel=1e-12)
            v, before[row] = clip(v + size * mixed, -1, 1), now
            moved.append(bounded(v, s + size * short_rate(v, s, x), x + size * long_rate(v, s, x)))
        expected = moved
    torch.testing.assert_close(
        torch.cat(state, -1), torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=0
    )


class StiffState(NamedTuple):
    voltage: torch.Tensor


class StiffField:
    """dv/dt = -1.5 v: with steps of 1 an Euler step overshoots by half."""

    def stability(self, machine):
        return torch.ones(1)

    def derivative(self, machine, state):
        return StiffState(-1.5 * state.voltage)

    def bound(self, machine, state):
        return state


def test_lag_damps_the_jumps_of_a_step_that_is_too_long():
    crossings = {}
    for lag in (0.0, 0.3):
        scheme, state = Splitting(change=1e9, dt_min=1.0, dt_max=1.0, lag=lag), StiffState(torch.ones(1, 1))
        rate, path = None, []
        for _ in range(12):
            state, _, rate = scheme.step(StiffField(), None, state, before=rate)
            path.append(state.voltage.item())
        crossings[lag] = sum(a * b < 0 for a, b in itertools.pairwise(path))
    assert crossings[0.3] < crossings[0.0] == 11


def test_schemes_by_hand_differ():
    results = {BY_HAND[scheme](*STATES[0], 0.3) for scheme in SCHEMES}
    assert len(results) == len(SCHEMES)


# --- orders of accuracy -----------------------------------------------------------------------------------


def ends(scheme, field, machine, state, duration, numbers):
    """The states after ``duration`` in each number of steps of equal size."""
    results = []
    for n in numbers:
        stepper, now = scheme(change=1e9, dt_min=duration / n, dt_max=duration / n), state
        for _ in range(n):
            now, dt, _ = stepper.step(field, machine, now)
            assert (dt == duration / n).all()
        results.append(torch.cat([x.flatten() for x in now]))
    return results


def order(scheme, field, machine, state, duration, n=16):
    """``log2`` of the ratio of the changes when the steps are halved twice."""
    coarse, middle, fine = ends(scheme, field, machine, state, duration, (n, 2 * n, 4 * n))
    return math.log2((coarse - middle).norm() / (middle - fine).norm())


def smooth_stretch():
    """A machine of bonds on a stretch of its way that meets no bound: see the test beneath."""
    field = BondField(alpha=0.3, beta=0.5, gamma=2.5, kappa=0.3, delta=4.0, zeta=0.3, long_term_max=9.0)
    machine = field.build(Qubo.from_matrix(normal(7, 7, seed=1)))
    state = field.init(machine, 0.5 * normal(3, 7, seed=2).tanh())
    half = {key: torch.full_like(getattr(state, key), 0.4) for key in ("short_term", "field_short_term")}
    more = {key: torch.full_like(getattr(state, key), 1.5) for key in ("long_term", "field_long_term")}
    return field, machine, state._replace(**half, **more)


def test_smooth_stretch_meets_no_bound():
    field, machine, state = smooth_stretch()
    integrator = AdaptiveEuler(change=1e9, dt_min=0.01, dt_max=0.01)
    start = state
    for _ in range(20):
        rate = field.derivative(machine, state)
        moved = type(state)(*(x + 0.01 * dx for x, dx in zip(state, rate, strict=True)))
        state, _, _ = integrator.step(field, machine, state)
        for a, b in zip(state, moved, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)
    assert all((a - b).abs().max() > 0.05 for a, b in zip(start, state, strict=True))


@pytest.mark.parametrize(("scheme", "expected"), [(AdaptiveEuler, 1), (Splitting, 1), (Strang, 1), (Heun, 2)])
def test_order_of_accuracy(scheme, expected):
    """Strang's splitting is of order 1 here, as its halves are steps of Euler's method."""
    assert order(scheme, *smooth_stretch(), duration=0.2) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_all_schemes_have_one_limit(scheme):
    field, machine, state = smooth_stretch()
    (reference,) = ends(Heun, field, machine, state, 0.2, (256,))
    errors = [(end - reference).norm().item() for end in ends(scheme, field, machine, state, 0.2, (16, 64, 256))]
    assert errors[0] > 2 * errors[1] > 4 * errors[2] or errors[2] < 1e-6
    assert errors[2] < 3e-3


class Pendulum(NamedTuple):
    voltage: torch.Tensor
    long_term: torch.Tensor


class PendulumField:
    """The voltage feels the memory alone and the memory the voltage alone: both halves of a step are exact."""

    def stability(self, machine):
        return torch.ones(1, dtype=torch.float64)

    def derivative(self, machine, state):
        return Pendulum(state.long_term.sin(), -state.voltage.sin())

    def bound(self, machine, state):
        return state


@pytest.mark.parametrize(("scheme", "expected"), [(AdaptiveEuler, 1), (Splitting, 1), (Strang, 2), (Heun, 2)])
def test_order_where_both_halves_of_a_splitting_are_exact(scheme, expected):
    state = Pendulum(*torch.tensor([[[0.3], [0.8]], [[1.1], [-0.4]]], dtype=torch.float64))
    assert order(scheme, PendulumField(), None, state, duration=1.0) == pytest.approx(expected, abs=0.1)


# --- step control -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
def test_step_sizes(scheme):
    integrator = scheme(change=0.5, dt_min=0.1, dt_max=2.0)
    rate = torch.tensor([[[0.0, 0.0], [0.6, -0.8], [-9.0, 1.0]], [[0.1, 0.2], [1.5, 2.0], [1e30, 1.0]]])
    root = math.sqrt(2)
    full = integrator.step_size(rate, torch.ones(2, 1))
    torch.testing.assert_close(full, torch.tensor([[2.0, 0.5 * root, 0.1], [2.0, 0.2 * root, 0.1]]))
    careful = integrator.step_size(rate, torch.tensor([[1.0], [0.6]]))
    slow = 0.3 / math.sqrt(0.025)
    torch.testing.assert_close(careful, torch.tensor([[2.0, 0.5 * root, 0.1], [slow, 0.12 * root, 0.1]]))


@pytest.mark.parametrize("scheme", SCHEMES)
def test_steps_follow_the_stability_of_each_problem(scheme):
    """The second problem couples 5 of its 13 variables."""
    full = normal(13, 13, seed=1)
    qubo = Qubo.from_matrix(torch.stack((full, full * (torch.arange(13) < 5) * (torch.arange(13) < 5)[:, None])))
    field = ClauseField()
    machine = field.build(qubo)
    stability = field.stability(machine)
    assert stability[0, 0] > 1.1 * stability[1, 0]
    state = field.init(machine, normal(2, 5, 13, seed=2).tanh())
    _, dt, _ = scheme(change=0.3, dt_min=1e-9, dt_max=1e9).step(field, machine, state)
    size = field.derivative(machine, state).voltage.square().mean(-1).sqrt()
    torch.testing.assert_close(dt, stability * 0.3 / size)


# --- refusals ---------------------------------------------------------------------------------------------


def test_state_that_is_no_named_tuple_is_refused():
    class Loose:
        voltage = torch.zeros(1, 1)

    class LooseField(PendulumField):
        def derivative(self, machine, state):
            return Loose()

    with pytest.raises(TypeError, match="must be a NamedTuple of arrays, got Loose"):
        AdaptiveEuler().step(LooseField(), None, Loose())


@pytest.mark.parametrize("field", [ClauseField(), BondField()], ids=lambda field: type(field).__name__)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_solves_a_small_problem(scheme, field):
    qubo = Qubo.from_matrix(torch.tensor([[1.0, -3.0, 0.0], [0.0, 1.0, 2.0], [0.0, 0.0, -0.5]]))
    settings = {name: getattr(field.integrator, name) for name in ("change", "dt_min", "dt_max")}
    solver = DmmSolver(field=field, integrator=scheme(**settings), n_restarts=5, max_steps=50, quench_every=None)
    assert solver.minimise(qubo, generator=rng.stream(0, "solver")).best_energy.item() == -1
