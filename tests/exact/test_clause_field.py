"""The clause dynamics against its equations, clause by clause."""

import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.dmm import AdaptiveEuler, ClauseField
from memcomp_lightning.dmm.clause import ClauseState
from memcomp_lightning.qubo import Bipartite, EdgeList, Qubo, WeightedMaxSat, from_model, from_qubo
from memcomp_lightning.testing.conformance import small_rbm

SPARSE = EdgeList(n=7, pairs=torch.tensor([[0, 1], [0, 3], [1, 6], [2, 3], [2, 6], [3, 6], [4, 6]]))
GRAPHS = {"bipartite 5 + 3": Bipartite(5, 3), "bipartite 3 + 5": Bipartite(3, 5), "edge list": SPARSE}
LARGEST_DEGREE = {"bipartite 5 + 3": 5, "bipartite 3 + 5": 5, "edge list": 4}


def normal(*shape, seed):
    return torch.empty(shape, dtype=torch.float64).normal_(generator=rng.stream(seed, "test draws"))


def uniform(*shape, low, high, seed):
    draw = torch.empty(shape, dtype=torch.float64)
    return draw.uniform_(low, high, generator=rng.stream(seed, "test draws"))


def random_maxsat(graph, problems=()):
    """Every combination of polarities, one variable without a unit clause."""
    shape = (*problems, *graph.edge_shape)
    unit = normal(*problems, graph.n, seed=4)
    unit[..., 1] = 0
    return WeightedMaxSat(
        graph=graph,
        weight=normal(*shape, seed=1).abs(),
        first=normal(*shape, seed=2).sign(),
        second=normal(*shape, seed=3).sign(),
        unit=unit,
        offset=normal(*problems, seed=5),
    )


def random_state(graph, problems, n_restarts, long_term_max):
    """Voltages with ties, at the bounds, and close enough to them for decaying memories."""
    voltage = uniform(*problems, n_restarts, graph.n, low=-1, high=1, seed=6)
    voltage[..., 0, :] = voltage[..., 0, :].sign()
    voltage[..., 1, :] = 0.5 * voltage[..., 1, :].sign()
    edges = (*problems, n_restarts, *graph.edge_shape)
    return ClauseState(
        voltage=voltage,
        short_term=uniform(*edges, low=0, high=1, seed=7),
        long_term=uniform(*edges, low=1, high=long_term_max, seed=8),
        unit_long_term=uniform(*problems, n_restarts, graph.n, low=1, high=long_term_max, seed=9),
    )


def derivative_by_loop(field, maxsat, state, largest_degree):
    """One problem, one restart: plain floats, the equations of ClauseField's docstring."""
    edges = maxsat.graph.edges().tolist()
    weights, q, p = (x.flatten().tolist() for x in (maxsat.weight, maxsat.first, maxsat.second))
    scale = math.sqrt(sum(w * w for w in weights) / len(weights)) * math.sqrt(largest_degree)
    v = state.voltage.tolist()
    short, long = state.short_term.flatten().tolist(), state.long_term.flatten().tolist()
    y = state.unit_long_term.tolist()

    def memory_rate(c, x):
        return field.alpha * (c - field.delta) * (x - 1 if c < field.delta else 1)

    dv, dshort, dlong = [0.0] * len(v), [], []
    for m, (i, j) in enumerate(edges):
        w = weights[m] / scale
        c = 0.5 * min(1 - q[m] * v[i], 1 - p[m] * v[j])
        gradient = {i: 0.5 * q[m] * (1 - p[m] * v[j]), j: 0.5 * p[m] * (1 - q[m] * v[i])}
        first_attains = 1 - q[m] * v[i] <= 1 - p[m] * v[j]
        rigidity = {
            i: 0.5 * (q[m] - v[i]) if first_attains else 0.0,
            j: 0.0 if first_attains else 0.5 * (p[m] - v[j]),
        }
        for k in (i, j):
            dv[k] += w * (
                long[m] * short[m] * gradient[k] + (1 + field.zeta * long[m]) * (1 - short[m]) * rigidity[k]
            )
        dshort.append(field.beta * (short[m] + field.epsilon) * (c - field.gamma))
        dlong.append(memory_rate(c, long[m]))
    dy = []
    for k, u in enumerate(maxsat.unit.tolist()):
        dv[k] += field.unit_pull * u / scale * y[k]
        sign = (u > 0) - (u < 0)
        dy.append(memory_rate(0.5 * (1 - sign * v[k]), y[k]))
    shape = maxsat.graph.edge_shape
    as_tensors = (torch.tensor(x, dtype=torch.float64) for x in (dv, dshort, dlong, dy))
    dv, dshort, dlong, dy = as_tensors
    return ClauseState(dv, dshort.view(shape), dlong.view(shape), dy)


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize(
    "field",
    [
        ClauseField(),
        ClauseField(
            alpha=1.3, beta=2.1, gamma=0.27, delta=0.19, epsilon=0.3, zeta=0.7, long_term_max=5.0, unit_pull=1.7
        ),
    ],
    ids=["default", "other constants"],
)
def test_derivative_is_the_equations_clause_by_clause(name, field):
    graph = GRAPHS[name]
    maxsat = random_maxsat(graph)
    state = random_state(graph, (), 11, field.long_term_max)
    rate = field.derivative(field.build(maxsat), state)
    for restart in range(11):
        one = ClauseState(*(x[restart] for x in state))
        expected = derivative_by_loop(field, maxsat, one, LARGEST_DEGREE[name])
        for key, ours, theirs in zip(ClauseState._fields, rate, expected, strict=True):
            torch.testing.assert_close(
                ours[restart], theirs, rtol=1e-12, atol=1e-12, msg=lambda text, key=key: f"{key}: {text}"
            )


def test_random_states_meet_ties_and_decaying_memories():
    maxsat, state = random_maxsat(SPARSE), random_state(SPARSE, (), 11, 3.3)
    first, second = SPARSE.gather(state.voltage)
    false_first, false_second = (1 - maxsat.first * first) / 2, (1 - maxsat.second * second) / 2
    assert (false_first == false_second).any()
    assert (torch.minimum(false_first, false_second) < ClauseField().delta).any()


@pytest.mark.parametrize("name", GRAPHS)
def test_problems_and_restarts_do_not_mix(name):
    graph, field = GRAPHS[name], ClauseField()
    maxsat, state = random_maxsat(graph, (2, 3)), random_state(graph, (2, 3), 5, 3.3)
    together = field.derivative(field.build(maxsat), state)
    for i, j in ((i, j) for i in range(2) for j in range(3)):
        parts = (maxsat.weight, maxsat.first, maxsat.second, maxsat.unit, maxsat.offset)
        alone = WeightedMaxSat(graph, *(x[i, j] for x in parts))
        one = field.derivative(field.build(alone), ClauseState(*(x[i, j] for x in state)))
        for a, b in zip(together, one, strict=True):
            torch.testing.assert_close(a[i, j], b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-12, 1e7])
def test_derivative_does_not_depend_on_the_scale_of_the_problem(scale):
    maxsat, state = random_maxsat(SPARSE), random_state(SPARSE, (), 5, 3.3)
    larger = WeightedMaxSat(
        SPARSE, maxsat.weight * scale, maxsat.first, maxsat.second, maxsat.unit * scale, maxsat.offset
    )
    field = ClauseField()
    for a, b in zip(
        field.derivative(field.build(maxsat), state), field.derivative(field.build(larger), state), strict=True
    ):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


def test_solution_is_a_fixed_point_of_the_bounded_voltages():
    qubo = Qubo.from_matrix(torch.tensor([[-1.0, -2.0], [0.0, -1.0]]).double())
    field = ClauseField()
    machine = field.build(from_qubo(qubo))
    state = field.init(machine, 3, generator=rng.stream(0, "solver"))._replace(voltage=torch.ones(3, 2).double())
    rate = field.derivative(machine, state)
    assert (rate.voltage >= 0).all()
    assert (rate.short_term < 0).all()


def test_initial_state():
    maxsat = random_maxsat(SPARSE, (2,))
    field = ClauseField()
    machine = field.build(maxsat)
    state = field.init(machine, 1009, generator=rng.stream(0, "solver"))
    assert state.voltage.shape == (2, 1009, 7)
    assert state.voltage.abs().max() <= 1
    assert abs(state.voltage.mean()) < 5 / math.sqrt(3 * state.voltage.numel())
    assert abs(state.voltage.square().mean() - 1 / 3) < 0.02
    first, second = SPARSE.gather(state.voltage)
    unsatisfied = 0.5 * torch.minimum(
        1 - maxsat.first.unsqueeze(1) * first, 1 - maxsat.second.unsqueeze(1) * second
    )
    torch.testing.assert_close(state.short_term, unsatisfied)
    assert (state.long_term == 1).all()
    assert (state.unit_long_term == 1).all()


def test_euler_step_by_hand():
    maxsat, state = random_maxsat(SPARSE), random_state(SPARSE, (), 11, 3.3)
    field = ClauseField()
    machine = field.build(maxsat)
    rate = field.derivative(machine, state)
    integrator = AdaptiveEuler(max_change=1.0, dt_min=0.16, dt_max=0.22)
    after, dt = integrator.step(field, machine, state)
    expected = [min(max(1.0 / max(map(abs, row)), 0.16), 0.22) for row in rate.voltage.tolist()]
    assert {0.16, 0.22} < set(expected)
    torch.testing.assert_close(dt, torch.tensor(expected, dtype=torch.float64))
    bounds = {"voltage": (-1, 1), "short_term": (0, 1), "long_term": (1, 3.3), "unit_long_term": (1, 3.3)}
    for key, (low, high) in bounds.items():
        moved = getattr(state, key) + dt.unsqueeze(-1) * getattr(rate, key)
        torch.testing.assert_close(getattr(after, key), moved.clamp(low, high))


def steps(maxsat, n_steps, n_restarts=5):
    field, integrator = ClauseField(), AdaptiveEuler()
    machine = field.build(maxsat)
    state = field.init(machine, n_restarts, generator=rng.stream(0, "solver"))
    for _ in range(n_steps):
        state, dt = integrator.step(field, machine, state)
        assert (dt >= integrator.dt_min * (1 - 1e-6)).all()
        assert (dt <= integrator.dt_max * (1 + 1e-6)).all()
        yield state


def test_state_stays_within_bounds_and_touches_them():
    reached = {"short": False, "long": False}
    for state in steps(from_qubo(from_model(small_rbm(11, 7))), 211):
        assert state.voltage.abs().max() <= 1
        assert state.short_term.min() >= 0
        assert state.short_term.max() <= 1
        for memory in (state.long_term, state.unit_long_term):
            assert memory.min() >= 1
            assert memory.max() <= torch.tensor(3.3)
        reached["short"] |= bool((state.short_term == 0).any())
        reached["long"] |= bool((state.long_term == state.long_term.max()).any() and state.long_term.max() > 3.29)
    assert all(reached.values())


def extreme(kind):
    matrix = normal(7, 7, seed=1).float()
    mixed = matrix * 1e-30
    mixed[0, 0] = 1.0
    return {
        "tiny": matrix * 1e-30,
        "huge": matrix * 1e30,
        "zero": torch.zeros(5, 5),
        "no couplings": torch.diag(torch.tensor([1.0, -2.0, 0.0])),
        "one variable": torch.tensor([[-3.0]]),
        "one huge coupling": matrix + 1e30 * torch.eye(7).roll(1, 0),
        "couplings far below a unit clause": mixed,
    }[kind]


@pytest.mark.parametrize(
    "kind",
    [
        "tiny",
        "huge",
        "zero",
        "no couplings",
        "one variable",
        "one huge coupling",
        "couplings far below a unit clause",
    ],
)
def test_extreme_problems_stay_finite(kind):
    for state in steps(from_qubo(Qubo.from_matrix(extreme(kind))), 101):
        assert all(bool(x.isfinite().all()) for x in state)
