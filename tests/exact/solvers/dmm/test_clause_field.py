"""The clause dynamics against its equations, clause by clause."""

import dataclasses
import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.problems import Bipartite, EdgeList, Qubo, WeightedMaxSat, from_model, from_qubo
from memcomp_lightning.problems.maxsat import Clauses
from memcomp_lightning.solvers.dmm import AdaptiveEuler, ClauseField, Splitting
from memcomp_lightning.solvers.dmm.clause import ClauseState
from memcomp_lightning.solvers.dmm.scaling import DEGREE_EXPONENT, SIZE_EXPONENT
from memcomp_lightning.testing.conformance import small_rbm

SPARSE = EdgeList(n=7, pairs=torch.tensor([[0, 1], [0, 3], [1, 6], [2, 3], [2, 6], [3, 6], [4, 6]]))
GRAPHS = {"bipartite 5 + 3": Bipartite(5, 3), "bipartite 3 + 5": Bipartite(3, 5), "edge list": SPARSE}
OTHER = ClauseField(
    alpha=1.3, beta=2.1, gamma=0.27, delta=0.19, epsilon=0.3, zeta=0.7, long_term_max=5.0, unit_pull=1.7
)
LENGTHS = {3: 5, 4: 3, 5: 2}


def normal(*shape, seed):
    return torch.empty(shape, dtype=torch.float64).normal_(generator=rng.stream(seed, "test draws"))


def uniform(*shape, low, high, seed):
    draw = torch.empty(shape, dtype=torch.float64)
    return draw.uniform_(low, high, generator=rng.stream(seed, "test draws"))


def longer_clauses(n, problems):
    """Clauses of 3, 4 and 5 literals."""
    return tuple(
        Clauses(
            variables=uniform(number, n, low=0, high=1, seed=length).argsort(-1)[:, :length],
            polarity=normal(number, length, seed=10 + length).sign(),
            weight=normal(*problems, number, seed=20 + length).abs(),
        )
        for length, number in LENGTHS.items()
    )


def random_maxsat(graph, problems=(), longer=False):
    """Every combination of polarities, one variable without a unit clause."""
    shape = (*problems, *graph.edge_shape)
    unit = 0.3 * normal(*problems, graph.n, seed=4)
    unit[..., 1] = 0
    return WeightedMaxSat(
        graph=graph,
        weight=normal(*shape, seed=1).abs(),
        first=normal(*shape, seed=2).sign(),
        second=normal(*shape, seed=3).sign(),
        unit=unit,
        offset=normal(*problems, seed=5),
        longer=longer_clauses(graph.n, problems) if longer else (),
    )


def random_state(maxsat, n_restarts, long_term_max, ties=True):
    """Voltages with ties, at the bounds, and close enough to them for decaying memories."""
    restarts = (*maxsat.problems, n_restarts)
    voltage = uniform(*restarts, maxsat.n, low=-1, high=1, seed=6)
    if ties:
        voltage[..., 0, :] = voltage[..., 0, :].sign()
        voltage[..., 1, :] = 0.5 * voltage[..., 1, :].sign()
    edges = (*restarts, *maxsat.graph.edge_shape)
    longer = (*restarts, sum(block.weight.shape[-1] for block in maxsat.longer))
    return ClauseState(
        voltage=voltage,
        short_term=uniform(*edges, low=0, high=1, seed=7),
        long_term=uniform(*edges, low=1, high=long_term_max, seed=8),
        unit_long_term=uniform(*restarts, maxsat.n, low=1, high=long_term_max, seed=9),
        longer_short_term=uniform(*longer, low=0, high=1, seed=30),
        longer_long_term=uniform(*longer, low=1, high=long_term_max, seed=31),
    )


def pairs_by_loop(maxsat):
    """One problem: the pairs as (weight, [(variable, polarity), ...])."""
    q, p = (x.expand(maxsat.weight.shape).flatten().tolist() for x in (maxsat.first, maxsat.second))
    edges = maxsat.graph.edges().tolist()
    literals = [[(i, a), (j, b)] for (i, j), a, b in zip(edges, q, p, strict=True)]
    return list(zip(maxsat.weight.flatten().tolist(), literals, strict=True))


def longer_by_loop(maxsat):
    return [
        (weight, list(zip(variables, polarity, strict=True)))
        for block in maxsat.longer
        for weight, variables, polarity in zip(
            block.weight.tolist(), block.variables.tolist(), block.polarity.tolist(), strict=True
        )
    ]


def root_mean_square_of_norms(clauses):
    """Over the variables that have a weight: the root mean square of ``sqrt(sum_m w_m^2)``."""
    power = {}
    for weight, literals in clauses:
        for variable, _ in literals:
            power[variable] = power.get(variable, 0.0) + weight**2
    coupled = [x for x in power.values() if x > 0]
    return math.sqrt(sum(coupled) / len(coupled)) if coupled else 1.0


def falsehoods(literals, v):
    return [0.5 * (1 - q * v[i]) for i, q in literals]


def derivative_by_loop(field, maxsat, state):
    """One problem, one restart: plain floats, the equations of ClauseField's docstring."""
    pairs, longer = pairs_by_loop(maxsat), longer_by_loop(maxsat)
    scale = root_mean_square_of_norms(pairs)
    v, y = state.voltage.tolist(), state.unit_long_term.tolist()

    def long_rate(c, x):
        return field.alpha * (c - field.delta) * (x - 1 if c < field.delta else 1)

    dv = [0.0] * len(v)

    def rates(clauses, short_term, long_term):
        shorts, longs = [], []
        memories = zip(short_term.flatten().tolist(), long_term.flatten().tolist(), strict=True)
        for (weight, literals), (short, long) in zip(clauses, memories, strict=True):
            false = falsehoods(literals, v)
            c = min(false)
            for at, (i, q) in enumerate(literals):
                gradient = q * min(false[:at] + false[at + 1 :])
                rigidity = q * c if at == false.index(c) else 0.0
                agility = long * short * gradient + (1 + field.zeta * long) * (1 - short) * rigidity
                dv[i] += weight / scale * agility
            shorts.append(field.beta * (short + field.epsilon) * (c - field.gamma))
            longs.append(long_rate(c, long))
        return shorts, longs

    of_pairs = rates(pairs, state.short_term, state.long_term)
    of_longer = rates(longer, state.longer_short_term, state.longer_long_term)
    dy = []
    for i, u in enumerate(maxsat.unit.tolist()):
        limit = max(1.0, 2 * sum(w / scale for w, literals in pairs if i in dict(literals)))
        u_scaled = min(max(u / scale, -limit), limit)
        dv[i] += field.unit_pull * u_scaled * y[i]
        sign = (u > 0) - (u < 0)
        dy.append(long_rate(0.5 * (1 - sign * v[i]), y[i]))
    tensors = (torch.tensor(x, dtype=torch.float64) for x in (dv, *of_pairs, dy, *of_longer))
    return ClauseState(*(x.view(like.shape) for x, like in zip(tensors, state, strict=True)))


def close(ours, theirs, rtol=1e-12):
    for key, a, b in zip(ClauseState._fields, ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=rtol, msg=lambda text, key=key: f"{key}: {text}")


def alone(maxsat, at):
    """One problem of several."""
    parts = {key: getattr(maxsat, key)[at] for key in ("weight", "first", "second", "unit", "offset")}
    longer = tuple(dataclasses.replace(block, weight=block.weight[at]) for block in maxsat.longer)
    return dataclasses.replace(maxsat, **parts, longer=longer)


# --- the equations ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("longer", [False, True], ids=["pairs", "longer clauses"])
@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("field", [ClauseField(), OTHER], ids=["default", "other constants"])
def test_derivative_is_the_equations_clause_by_clause(name, field, longer):
    maxsat = random_maxsat(GRAPHS[name], longer=longer)
    state = random_state(maxsat, 11, field.long_term_max)
    rate = field.derivative(field.build(maxsat), state)
    for restart in range(11):
        one = ClauseState(*(x[restart] for x in state))
        close(ClauseState(*(x[restart] for x in rate)), derivative_by_loop(field, maxsat, one))


def test_random_states_meet_ties_and_decaying_memories():
    maxsat = random_maxsat(SPARSE, longer=True)
    state = random_state(maxsat, 11, OTHER.long_term_max)
    smallest = []
    for v in state.voltage.tolist():
        for _, literals in pairs_by_loop(maxsat) + longer_by_loop(maxsat):
            first, second = sorted(falsehoods(literals, v))[:2]
            smallest.append((len(literals), first == second, first < OTHER.delta))
    for length in (2, *LENGTHS):
        assert any(tie for k, tie, _ in smallest if k == length)
        assert any(decays for k, _, decays in smallest if k == length)


@pytest.mark.parametrize("problems", [(3,), (2, 3)], ids=str)
@pytest.mark.parametrize("longer", [False, True], ids=["pairs", "longer clauses"])
@pytest.mark.parametrize("name", GRAPHS)
def test_problems_and_restarts_do_not_mix(name, longer, problems):
    maxsat = random_maxsat(GRAPHS[name], problems, longer=longer)
    field, state = OTHER, random_state(maxsat, 5, OTHER.long_term_max)
    machine = field.build(maxsat)
    together, start = field.derivative(machine, state), field.init(machine, state.voltage)
    for at in torch.cartesian_prod(*map(torch.arange, problems)).reshape(-1, len(problems)).tolist():
        at = tuple(at)
        machine = field.build(alone(maxsat, at))
        one = ClauseState(*(x[at] for x in state))
        close(ClauseState(*(x[at] for x in together)), field.derivative(machine, one))
        close(ClauseState(*(x[at] for x in start)), field.init(machine, one.voltage))


@pytest.mark.parametrize("name", GRAPHS)
def test_initial_memories(name):
    maxsat = random_maxsat(GRAPHS[name], longer=True)
    voltage = random_state(maxsat, 11, 2.0).voltage
    state = OTHER.init(OTHER.build(maxsat), voltage)
    assert state.voltage.equal(voltage)
    for restart, v in enumerate(voltage.tolist()):
        for clauses, short_term in (
            (pairs_by_loop(maxsat), state.short_term),
            (longer_by_loop(maxsat), state.longer_short_term),
        ):
            expected = torch.tensor([min(falsehoods(literals, v)) for _, literals in clauses]).double()
            torch.testing.assert_close(short_term[restart].flatten(), expected, rtol=1e-6, atol=1e-6)
    shapes = (state.short_term.shape, voltage.shape, state.longer_short_term.shape)
    for long_term, shape in zip(
        (state.long_term, state.unit_long_term, state.longer_long_term), shapes, strict=True
    ):
        assert long_term.shape == shape
        assert (long_term == 1).all()


def test_solution_is_a_fixed_point_of_the_bounded_voltages():
    qubo = Qubo.from_matrix(torch.tensor([[-1.0, -2.0], [0.0, -1.0]]).double())
    field = ClauseField()
    machine = field.build(from_qubo(qubo))
    rate = field.derivative(machine, field.init(machine, torch.ones(3, 2).double()))
    assert (rate.voltage >= 0).all()
    assert (rate.short_term < 0).all()


def test_bounds_are_reached_and_never_crossed():
    field = ClauseField(alpha=7.6, beta=0.39, gamma=0.033, delta=0.0073, epsilon=0.041, long_term_max=3.3)
    integrator = AdaptiveEuler(change=2.35, dt_min=0.0126, dt_max=2.8)
    machine = field.build(from_model(small_rbm(11, 7).double()))
    state = field.init(machine, uniform(5, 18, low=-1, high=1, seed=0))
    reached, most = {"short": False, "long": False}, field.most_long_term(machine.degree)
    assert 1 < most < 3.3
    for _ in range(211):
        state, _, _ = integrator.step(field, machine, state)
        assert state.voltage.abs().max() <= 1
        assert state.short_term.min() >= 0
        assert state.short_term.max() <= 1
        for memory in (state.long_term, state.unit_long_term):
            assert memory.min() >= 1
            assert memory.max() <= most
        reached["short"] |= bool((state.short_term == 0).any())
        reached["long"] |= bool((state.long_term == most).any())
    assert all(reached.values())


# --- units and invariances --------------------------------------------------------------------------------


def derivative_of(maxsat, state, field=OTHER):
    return field.derivative(field.build(maxsat), state)


@pytest.mark.parametrize("longer", [False, True], ids=["pairs", "longer clauses"])
def test_variables_without_couplings_do_not_change_the_steps(longer):
    """Their rates are 0: the root mean square over more variables is smaller, the factor makes up for it."""
    maxsat = random_maxsat(SPARSE, longer=longer)
    n = SPARSE.n
    more = dataclasses.replace(
        maxsat,
        graph=dataclasses.replace(SPARSE, n=n + 40),
        unit=torch.nn.functional.pad(maxsat.unit, (0, 40)),
    )
    steps = []
    for problem in (maxsat, more):
        machine = OTHER.build(problem)
        voltage = uniform(5, n, low=-1, high=1, seed=0)
        state = OTHER.init(machine, torch.nn.functional.pad(voltage, (0, problem.n - n)))
        rate = OTHER.derivative(machine, state).voltage
        steps.append(Splitting(dt_min=1e-9, dt_max=1e9).step_size(rate, OTHER.stability(machine)))
    torch.testing.assert_close(*steps, rtol=1e-6, atol=0)


@pytest.mark.parametrize("longer", [False, True], ids=["pairs", "longer clauses"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("factor", [1e-30, 1e-12, 1e7, 1e30])
def test_scale_of_the_problem_does_not_matter(factor, dtype, longer):
    maxsat = random_maxsat(SPARSE, longer=longer)

    def times(factor, x):
        return (x * factor).to(dtype)

    def scaled(factor):
        longer = tuple(
            dataclasses.replace(block, weight=times(factor, block.weight), polarity=block.polarity.to(dtype))
            for block in maxsat.longer
        )
        return WeightedMaxSat(
            graph=SPARSE,
            weight=times(factor, maxsat.weight),
            first=maxsat.first.to(dtype),
            second=maxsat.second.to(dtype),
            unit=times(factor, maxsat.unit),
            offset=maxsat.offset,
            longer=longer,
        )

    state = ClauseState(*(x.to(dtype) for x in random_state(maxsat, 5, OTHER.long_term_max)))
    tolerance = 1e-4 if dtype == torch.float32 else 1e-12
    close(derivative_of(scaled(1.0), state), derivative_of(scaled(factor), state), tolerance)


@pytest.mark.parametrize("name", GRAPHS)
def test_a_random_assignment_drives_a_variable_with_a_strength_of_one(name):
    """In the machine's units the strengths of the coupled variables have a root mean square of 1."""
    machine = OTHER.build(random_maxsat(GRAPHS[name]))
    power = machine.weight.square().squeeze(0)
    per_variable = GRAPHS[name].scatter(power, power)
    assert per_variable[per_variable > 0].mean().item() == pytest.approx(1, rel=1e-12)


def test_without_pairs_the_longer_clauses_set_the_scale():
    maxsat = random_maxsat(EdgeList(n=7, pairs=torch.zeros(0, 2, dtype=torch.int64)), longer=True)
    clauses = longer_by_loop(maxsat)
    weights = torch.tensor([weight for weight, _ in clauses], dtype=torch.float64)
    expected = weights / root_mean_square_of_norms(clauses)
    torch.testing.assert_close(OTHER.build(maxsat).longer_weight.squeeze(0), expected)


@pytest.mark.parametrize("pairs", [SPARSE, EdgeList(7, SPARSE.pairs[:0])], ids=["pairs", "no pairs"])
def test_clauses_of_no_weight_change_nothing(pairs):
    maxsat = random_maxsat(pairs, longer=True)
    state = random_state(maxsat, 5, OTHER.long_term_max)
    one, zero = torch.ones(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    longer = longer_clauses(7, ())
    padded = dataclasses.replace(
        maxsat,
        graph=EdgeList(n=7, pairs=torch.cat((pairs.pairs, torch.tensor([[0, 2], [4, 5], [1, 5]])))),
        weight=torch.cat((maxsat.weight, zero)),
        first=torch.cat((maxsat.first, one)),
        second=torch.cat((maxsat.second, -one)),
        longer=(*longer, Clauses(longer[1].variables.flip(0, 1), longer[1].polarity, 0 * longer[1].weight)),
    )
    added = random_state(padded, 5, OTHER.long_term_max)
    sizes = [x.shape[-1] for x in state]
    padded_state = ClauseState(
        *(torch.cat((x, y[:, size:]), dim=-1) for x, y, size in zip(state, added, sizes, strict=True))
    )
    after = derivative_of(padded, padded_state)
    assert after.short_term.shape[-1] == sizes[1] + 3
    assert after.longer_short_term.shape[-1] == sizes[4] + 3
    close(derivative_of(maxsat, state), ClauseState(*(x[:, :size] for x, size in zip(after, sizes, strict=True))))


def test_isolated_variables_change_nothing():
    maxsat = random_maxsat(SPARSE, longer=True)
    state = random_state(maxsat, 5, OTHER.long_term_max)

    def widened(x, value=0.0):
        return torch.cat((x, torch.full((*x.shape[:-1], 3), value, dtype=x.dtype)), dim=-1)

    wide = dataclasses.replace(maxsat, graph=EdgeList(n=10, pairs=SPARSE.pairs), unit=widened(maxsat.unit))
    wide_state = state._replace(
        voltage=widened(state.voltage, 0.4), unit_long_term=widened(state.unit_long_term, 1.5)
    )
    after = derivative_of(wide, wide_state)
    assert (after.voltage[:, 7:] == 0).all()
    close(
        derivative_of(maxsat, state),
        after._replace(voltage=after.voltage[:, :7], unit_long_term=after.unit_long_term[:, :7]),
    )


def test_names_of_variables_and_order_of_clauses_do_not_matter():
    maxsat = random_maxsat(SPARSE, longer=True)
    state = random_state(maxsat, 5, OTHER.long_term_max, ties=False)
    new_name, order = torch.tensor([3, 6, 0, 5, 1, 2, 4]), torch.tensor([5, 2, 6, 0, 1, 4, 3])
    old_name = new_name.argsort()
    pairs = new_name[SPARSE.pairs[order]]
    swapped = pairs[:, 0] > pairs[:, 1]
    first, second = maxsat.first[order], maxsat.second[order]
    renamed = dataclasses.replace(
        maxsat,
        graph=EdgeList(n=7, pairs=pairs.sort(-1).values),
        weight=maxsat.weight[order],
        first=torch.where(swapped, second, first),
        second=torch.where(swapped, first, second),
        unit=maxsat.unit[old_name],
        longer=tuple(
            Clauses(new_name[b.variables].flip(0, 1), b.polarity.flip(0, 1), b.weight.flip(0))
            for b in maxsat.longer
        ),
    )
    sizes = list(LENGTHS.values())
    flipped = torch.cat([part.flip(0) for part in torch.arange(sum(sizes)).split(sizes)])

    def rename(state):
        return ClauseState(
            voltage=state.voltage[:, old_name],
            short_term=state.short_term[:, order],
            long_term=state.long_term[:, order],
            unit_long_term=state.unit_long_term[:, old_name],
            longer_short_term=state.longer_short_term[:, flipped],
            longer_long_term=state.longer_long_term[:, flipped],
        )

    close(rename(derivative_of(maxsat, state)), derivative_of(renamed, rename(state)))


@pytest.mark.parametrize("size", [1e3, 1e6, 1e11])
def test_a_huge_unit_clause_is_limited_to_what_decides_its_variable(size):
    maxsat = random_maxsat(SPARSE)
    maxsat.unit[3], maxsat.unit[5] = size, -size
    machine = OTHER.build(maxsat)
    scale = root_mean_square_of_norms(pairs_by_loop(maxsat))
    at_three = sum(w / scale for w, literals in pairs_by_loop(maxsat) if 3 in dict(literals))
    assert machine.unit[0, 3].item() == pytest.approx(max(1.0, 2 * at_three), rel=1e-3)
    assert machine.unit[0, 5].item() == -1  # it is in no pair
    small = maxsat.unit.abs() < scale
    torch.testing.assert_close(machine.unit[0, small], maxsat.unit[small] / scale, rtol=1e-3, atol=0)


def test_steps_are_shorter_in_larger_problems():
    """By the number of coupled variables alone."""
    for n in (13, 53):
        random = Qubo.from_matrix(normal(n, n, seed=1))
        by_size = (n / 200) ** -SIZE_EXPONENT
        assert OTHER.stability(OTHER.build(random)).item() == pytest.approx(by_size, rel=1e-6)
    alike = torch.ones(13, 13).double().triu(1)
    both = Qubo.from_matrix(torch.stack((alike, -alike * 5)))
    expected = torch.full((2, 1), (13 / 200) ** -SIZE_EXPONENT).double()
    torch.testing.assert_close(OTHER.stability(OTHER.build(both)), expected)


# --- degree -----------------------------------------------------------------------------------------------


def ring(n, weights=(1.0, 1.0), n_isolated=0):
    """Each variable has two neighbours."""
    first = torch.arange(n)
    values = torch.tensor(weights, dtype=torch.float64)[first % 2]
    return Qubo.from_coo(n + n_isolated, first, (first + 1) % n, values)


@pytest.mark.parametrize(
    ("qubo", "degree"),
    [
        (ring(8), 2.0),
        (ring(8, n_isolated=5), 2.0),
        (ring(8, weights=(-1e30, 1e30)), 2.0),
        (ring(8, weights=(1.0, 0.5)), 1.5**2 / 1.25),
        (ring(8, weights=(1.0, 0.0)), 1.0),
        (Qubo.from_matrix(torch.ones(13, 13).double().triu(1)), 12.0),
        (
            Qubo(Bipartite(3, 5), torch.ones(5, 3).double(), torch.zeros(8).double(), torch.zeros(())),
            (3 * 5 + 5 * 3) / 8,
        ),
        (Qubo.from_matrix(torch.diag(torch.ones(3)).double()), 1.0),
    ],
    ids=["ring", "isolated", "huge", "uneven", "zeros", "complete", "layers", "no couplings"],
)
def test_effective_degree_counts_couplings_by_their_strength(qubo, degree):
    assert OTHER.build(qubo).degree.item() == pytest.approx(degree, rel=1e-6)


def test_effective_degree_counts_longer_clauses():
    """Variable 1 is in three clauses, 2 to 7 in one each."""
    clauses = [[1, 2], [1, 3, 4], [-1, 5, 6, 7]]
    problem = WeightedMaxSat.from_clauses(8, clauses, [1.0, 1.0, 1.0])
    assert OTHER.build(problem).degree.item() == pytest.approx((3 + 6 * 1) / 7)


@pytest.mark.parametrize("largest", [1.0, 5.0])
def test_long_term_memories_are_bounded_more_tightly_where_degrees_are_high(largest):
    field = dataclasses.replace(OTHER, long_term_max=largest)
    state = random_state(random_maxsat(SPARSE, longer=True), 5, 9.0)
    bounds = []
    for weight in (0.0, 1.0):
        maxsat = random_maxsat(SPARSE, longer=True)
        maxsat = dataclasses.replace(maxsat, weight=torch.cat((maxsat.weight[:1], weight * maxsat.weight[1:])))
        machine = field.build(maxsat)
        bounded = field.bound(machine, state)
        bounds.append(bounded.long_term.max().item())
        assert bounds[-1] == pytest.approx(1 + (largest - 1) * machine.degree.item() ** -DEGREE_EXPONENT)
        assert bounded.unit_long_term.max() <= bounds[-1]
        assert bounded.longer_long_term.max() <= bounds[-1]
    if largest > 1:
        assert bounds[0] != bounds[1]
