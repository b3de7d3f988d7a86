"""The bond dynamics against its equations, bond by bond."""

import dataclasses
import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Bipartite, EdgeList, Qubo, WeightedMaxSat, from_qubo
from memcomp_lightning.solvers.dmm import BondField
from memcomp_lightning.solvers.dmm.bond import BondMachine, BondState

SPARSE = EdgeList(n=7, pairs=torch.tensor([[0, 1], [0, 3], [1, 6], [2, 3], [2, 6], [3, 6], [4, 6]]))
GRAPHS = {"bipartite 5 + 3": Bipartite(5, 3), "bipartite 3 + 5": Bipartite(3, 5), "edge list": SPARSE}
OTHER = BondField(
    alpha=1.3,
    beta=2.1,
    gamma=0.7,
    kappa=0.4,
    delta=1.9,
    zeta=0.6,
    short_term_start=0.3,
    short_term_min=0.05,
    long_term_max=5.0,
)


def normal(*shape, seed):
    return torch.empty(shape, dtype=torch.float64).normal_(generator=rng.stream(seed, "test draws"))


def uniform(*shape, low, high, seed):
    draw = torch.empty(shape, dtype=torch.float64)
    return draw.uniform_(low, high, generator=rng.stream(seed, "test draws"))


def random_qubo(graph, problems=()):
    """One coupling is zero, one spin has no field; dyadic couplings up to 2, whose sums are exact in any order."""
    coupling = (normal(*problems, *graph.edge_shape, seed=1) * 1024).round().clamp(-2048, 2048) / 1024
    linear = 0.3 * normal(*problems, graph.n, seed=2)
    coupling[..., 0], coupling[..., 1] = 2, 0
    linear[..., 1] = -graph.scatter(coupling, coupling)[..., 1] / 2
    return Qubo(graph, coupling, linear, normal(*problems, seed=3))


def random_state(graph, problems, n_restarts, field):
    restarts = (*problems, n_restarts)
    edges = (*restarts, *graph.edge_shape)
    voltage = uniform(*restarts, graph.n, low=-1, high=1, seed=6)
    voltage[..., 0, :] = voltage[..., 0, :].sign()
    low, high = field.short_term_min, field.long_term_max
    return BondState(
        voltage=voltage,
        short_term=uniform(*edges, low=low, high=1, seed=7),
        long_term=uniform(*edges, low=1, high=high, seed=8),
        field_short_term=uniform(*restarts, graph.n, low=low, high=1, seed=9),
        field_long_term=uniform(*restarts, graph.n, low=1, high=high, seed=10),
    )


def spins_by_loop(qubo):
    """One problem: bonds J as (J, i, j) and fields h of the energy ``-sum J s_i s_j - sum h_i s_i + constant``."""
    bonds, h = [], [-x / 2 for x in qubo.linear.tolist()]
    for coupling, (i, j) in zip(qubo.coupling.flatten().tolist(), qubo.graph.edges().tolist(), strict=True):
        bonds.append((-coupling / 4, i, j))
        h[i] -= coupling / 4
        h[j] -= coupling / 4
    return bonds, h


def coupling_norm(bonds):
    """Over the spins that have a bond: the root mean square of ``sqrt(sum_j J_ij^2)``."""
    power = {}
    for strength, *ends in bonds:
        for i in ends:
            power[i] = power.get(i, 0.0) + strength**2
    coupled = [x for x in power.values() if x > 0]
    return math.sqrt(sum(coupled) / len(coupled)) if coupled else 1.0


def largest_eigenvalue(bonds, n):
    matrix = torch.zeros(n, n, dtype=torch.float64)
    for strength, i, j in bonds:
        matrix[i, j] += strength
        matrix[j, i] += strength
    return torch.linalg.eigvalsh(matrix).abs().max().item()


def derivative_by_loop(field, qubo, state):
    """One problem, one restart: plain floats, the equations of BondField's docstring."""
    bonds, h = spins_by_loop(qubo)
    scale = max(coupling_norm(bonds), largest_eigenvalue(bonds, qubo.n) / 2)
    bonds = [(strength / scale, i, j) for strength, i, j in bonds]
    strengths = [sum(abs(strength) for strength, *ends in bonds if i in ends) for i in range(qubo.n)]
    h = [
        min(max(x / scale, -limit), limit)
        for x, limit in zip(h, (max(1.0, 2 * total) for total in strengths), strict=True)
    ]
    coupled = [total for total in strengths if total > 0]
    s = sum(coupled) / len(coupled) if coupled else 1.0
    v = state.voltage.tolist()
    short, long = state.short_term.flatten().tolist(), state.long_term.flatten().tolist()
    field_short, field_long = state.field_short_term.tolist(), state.field_long_term.tolist()

    def memory_rates(strength, product, x, y):
        sign = (strength > 0) - (strength < 0)
        return field.gamma * (1 + field.kappa * sign * product) - y, field.delta * x - field.zeta

    drive, pull = [0.0] * len(v), [0.0] * len(v)
    rates = []
    for (strength, i, j), x, y in zip(bonds, short, long, strict=True):
        for a, b in ((i, j), (j, i)):
            drive[a] += strength * v[b]
            pull[a] += abs(strength) * x
        rates.append(memory_rates(strength, v[i] * v[j], x, y))
    field_rates = [memory_rates(*row) for row in zip(h, v, field_short, field_long, strict=True)]
    dv = [
        field.alpha * (drive[i] + h[i]) - 2 * field.beta * v[i] * (pull[i] + abs(h[i]) * field_short[i]) / s
        for i in range(len(v))
    ]
    tensors = (torch.tensor(x, dtype=torch.float64) for x in (dv, *zip(*rates), *zip(*field_rates)))  # noqa: B905
    return BondState(*(x.view(like.shape) for x, like in zip(tensors, state, strict=True)))


def close(ours, theirs, rtol=1e-12):
    for key, a, b in zip(BondState._fields, ours, theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=rtol, atol=rtol, msg=lambda text, key=key: f"{key}: {text}")


def rates_of(qubo, state, field=OTHER):
    return field.derivative(field.build(qubo), state)


# --- the equations ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", GRAPHS)
@pytest.mark.parametrize("field", [BondField(), OTHER], ids=["default", "other constants"])
def test_derivative_is_the_equations_bond_by_bond(name, field):
    qubo = random_qubo(GRAPHS[name])
    bonds, _ = spins_by_loop(qubo)
    assert largest_eigenvalue(bonds, qubo.n) < 2 * coupling_norm(bonds)
    state = random_state(qubo.graph, (), 11, field)
    rate = rates_of(qubo, state, field)
    for restart in range(11):
        expected = derivative_by_loop(field, qubo, BondState(*(x[restart] for x in state)))
        close(BondState(*(x[restart] for x in rate)), expected)


@pytest.mark.parametrize("sign", [1, -1])
def test_bonds_that_pull_alike_are_divided_by_half_their_largest_eigenvalue(sign):
    """The eigenvalue comes from a few power iterations."""
    ones = torch.ones(11, 11, dtype=torch.float64).triu(1)
    qubo = Qubo.from_matrix(sign * (ones + 0.1 * normal(11, 11, seed=1)))
    bonds, _ = spins_by_loop(qubo)
    assert largest_eigenvalue(bonds, 11) > 3 * coupling_norm(bonds)
    state = random_state(qubo.graph, (), 5, OTHER)
    rate = rates_of(qubo, state)
    for restart in range(5):
        expected = derivative_by_loop(OTHER, qubo, BondState(*(x[restart] for x in state)))
        close(BondState(*(x[restart] for x in rate)), expected, rtol=1e-3)


@pytest.mark.parametrize("problems", [(3,), (2, 3)], ids=str)
@pytest.mark.parametrize("name", GRAPHS)
def test_problems_and_restarts_do_not_mix(name, problems):
    qubo = random_qubo(GRAPHS[name], problems)
    state = random_state(qubo.graph, problems, 5, OTHER)
    machine = OTHER.build(qubo)
    together, start = OTHER.derivative(machine, state), OTHER.init(machine, state.voltage)
    for at in torch.cartesian_prod(*map(torch.arange, problems)).reshape(-1, len(problems)).tolist():
        at = tuple(at)
        alone = Qubo(qubo.graph, qubo.coupling[at], qubo.linear[at], qubo.offset[at])
        machine, one = OTHER.build(alone), BondState(*(x[at] for x in state))
        close(BondState(*(x[at] for x in together)), OTHER.derivative(machine, one))
        close(BondState(*(x[at] for x in start)), OTHER.init(machine, one.voltage))


def test_a_field_is_a_bond_to_a_spin_clamped_at_one():
    machine = OTHER.build(random_qubo(SPARSE))
    state = random_state(SPARSE, (), 5, OTHER)
    clamped = BondMachine(
        graph=EdgeList(n=8, pairs=torch.cat((SPARSE.pairs, torch.tensor([[i, 7] for i in range(7)])))),
        bond=torch.cat((machine.bond, machine.field), dim=-1),
        field=torch.zeros(1, 8, dtype=torch.float64),
        pull_scale=machine.pull_scale,
    )
    ones = torch.ones(5, 1, dtype=torch.float64)
    as_bonds = OTHER.derivative(
        clamped,
        BondState(
            voltage=torch.cat((state.voltage, ones), dim=-1),
            short_term=torch.cat((state.short_term, state.field_short_term), dim=-1),
            long_term=torch.cat((state.long_term, state.field_long_term), dim=-1),
            field_short_term=ones.expand(5, 8),
            field_long_term=ones.expand(5, 8),
        ),
    )
    rate = OTHER.derivative(machine, state)
    torch.testing.assert_close(as_bonds.voltage[:, :7], rate.voltage)
    torch.testing.assert_close(as_bonds.short_term, torch.cat((rate.short_term, rate.field_short_term), dim=-1))
    torch.testing.assert_close(as_bonds.long_term, torch.cat((rate.long_term, rate.field_long_term), dim=-1))


@pytest.mark.parametrize("name", GRAPHS)
def test_initial_memories(name):
    graph = GRAPHS[name]
    voltage = random_state(graph, (2,), 3, OTHER).voltage
    state = OTHER.init(OTHER.build(random_qubo(graph, (2,))), voltage)
    assert state.voltage.equal(voltage)
    for memory, shape, value in (
        (state.short_term, graph.edge_shape, OTHER.short_term_start),
        (state.long_term, graph.edge_shape, 1.0),
        (state.field_short_term, (graph.n,), OTHER.short_term_start),
        (state.field_long_term, (graph.n,), 1.0),
    ):
        assert memory.equal(torch.full((2, 3, *shape), value, dtype=torch.float64))


def test_bounds():
    state = BondState(*(uniform(11, 7, low=-2, high=7, seed=seed) for seed in range(5)))
    bounded = OTHER.bound(OTHER.build(random_qubo(SPARSE)), state)
    limits = {"voltage": (-1, 1), "short_term": (0.05, 1), "long_term": (1, 5)}
    for name, (low, high) in limits.items():
        for key in {name, f"field_{name}"} & set(BondState._fields):
            expected = [min(max(x, low), high) for x in getattr(state, key).flatten().tolist()]
            assert getattr(bounded, key).flatten().tolist() == expected
            assert {low, high} < set(expected)


# --- units and invariances --------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("power", [-100, -40, 23, 100])
def test_scale_of_the_problem_does_not_matter(power, dtype):
    """From 1e-30 to 1e30; powers of two, which keep a field of 0 that is a sum."""
    qubo = random_qubo(SPARSE)

    def scaled(factor):
        return Qubo(SPARSE, (factor * qubo.coupling).to(dtype), (factor * qubo.linear).to(dtype), qubo.offset)

    state = BondState(*(x.to(dtype) for x in random_state(SPARSE, (), 5, OTHER)))
    tolerance = 1e-4 if dtype == torch.float32 else 1e-12
    close(rates_of(scaled(1.0), state), rates_of(scaled(2.0**power), state), tolerance)


def test_bonds_of_no_strength_change_nothing():
    qubo = random_qubo(SPARSE)
    extra = torch.tensor([[0, 2], [4, 5], [1, 5]])
    padded = Qubo(
        EdgeList(n=7, pairs=torch.cat((SPARSE.pairs, extra))),
        torch.cat((qubo.coupling, torch.zeros(3, dtype=torch.float64))),
        qubo.linear,
        qubo.offset,
    )
    state = random_state(padded.graph, (), 5, OTHER)
    short = state._replace(short_term=state.short_term[:, :7], long_term=state.long_term[:, :7])
    after = rates_of(padded, state)
    close(
        rates_of(qubo, short),
        after._replace(short_term=after.short_term[:, :7], long_term=after.long_term[:, :7]),
    )


def test_isolated_variables_change_nothing():
    qubo = random_qubo(SPARSE)
    zeros = torch.zeros(3, dtype=torch.float64)
    wide = Qubo(EdgeList(n=10, pairs=SPARSE.pairs), qubo.coupling, torch.cat((qubo.linear, zeros)), qubo.offset)
    state = random_state(wide.graph, (), 5, OTHER)

    def narrowed(state):
        return BondState(*(x[:, :7] for x in state))

    after = rates_of(wide, state)
    assert (after.voltage[:, 7:] == 0).all()
    close(rates_of(qubo, narrowed(state)), narrowed(after))


def test_names_of_variables_and_order_of_bonds_do_not_matter():
    qubo = random_qubo(SPARSE)
    new_name, order = torch.tensor([3, 6, 0, 5, 1, 2, 4]), torch.tensor([5, 2, 6, 0, 1, 4, 3])
    old_name = new_name.argsort()
    renamed = Qubo(
        EdgeList(n=7, pairs=new_name[SPARSE.pairs[order]].sort(-1).values),
        qubo.coupling[order],
        qubo.linear[old_name],
        qubo.offset,
    )

    def rename(state):
        names = (old_name, order, order, old_name, old_name)
        return BondState(*(x[:, name] for x, name in zip(state, names, strict=True)))

    state = random_state(SPARSE, (), 5, OTHER)
    close(rename(rates_of(qubo, state)), rates_of(renamed, rename(state)))


def test_maxsat_form_of_a_problem_gives_the_same_machine():
    qubo = random_qubo(SPARSE, (2,))
    for ours, theirs in zip(OTHER.build(from_qubo(qubo))[1:], OTHER.build(qubo)[1:], strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-12, atol=1e-12)


def test_clauses_of_three_literals_are_refused_with_the_remedy():
    problem = WeightedMaxSat.from_clauses(5, [[1, 2], [-1, 3, 4], [2, 3, -4, 5]], [1.0, 1.0, 2.0])
    with pytest.raises(
        SettingError, match=r"longest clause = 4 .* at most 2 literals.* DmmSolver\(field=ClauseField"
    ):
        OTHER.build(problem)


@pytest.mark.parametrize("size", [1e3, 1e6, 1e11])
def test_a_huge_field_is_limited_to_what_decides_its_spin(size):
    qubo = random_qubo(SPARSE)
    linear = qubo.linear.clone()
    linear[3], linear[5] = size, -size
    machine = OTHER.build(dataclasses.replace(qubo, linear=linear))
    strength = machine.graph.scatter(machine.bond.abs(), machine.bond.abs())
    assert machine.field[0, 3].item() == pytest.approx(-max(1.0, 2 * strength[0, 3].item()))
    assert machine.field[0, 5].item() == 1  # it has no bond
    others = torch.tensor([0, 1, 2, 4, 6])
    torch.testing.assert_close(machine.field[0, others], OTHER.build(qubo).field[0, others], rtol=1e-3, atol=1e-6)


def test_step_control_is_left_to_the_scale():
    assert OTHER.stability(OTHER.build(random_qubo(SPARSE, (2, 3)))).equal(torch.ones(2, 3, 1).double())
