"""QUBO and weighted MAX-SAT over all states."""

import itertools

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models.enumeration import binary_states
from memcomp_lightning.qubo import Bipartite, EdgeList, Qubo, WeightedMaxSat, from_model, from_qubo, to_qubo
from memcomp_lightning.testing.conformance import small_rbm

SPARSE = EdgeList(n=7, pairs=torch.tensor([[0, 1], [0, 3], [1, 6], [2, 3], [2, 6], [3, 6], [4, 6]]))
GRAPHS = {"bipartite 5 + 3": Bipartite(5, 3), "bipartite 3 + 5": Bipartite(3, 5), "edge list": SPARSE}


def normal(*shape, seed):
    return torch.empty(shape, dtype=torch.float64).normal_(generator=rng.stream(seed, "test draws"))


def problem(graph, problems=()):
    """Random numbers, a quarter of them zero."""
    coupling = normal(*problems, *graph.edge_shape, seed=1)
    linear = normal(*problems, graph.n, seed=2)
    coupling[normal(*coupling.shape, seed=3) > 0.7] = 0
    linear[normal(*linear.shape, seed=4) > 0.7] = 0
    return Qubo(graph, coupling, linear, normal(*problems, seed=5))


def all_states(qubo):
    states = binary_states(qubo.n, like=qubo.linear)
    return states.expand(*qubo.problems, *states.shape)


def energies_by_loop(qubo, states):
    """One problem, ``(n_states,)``: term by term."""
    edges, coupling = qubo.graph.edges().tolist(), qubo.coupling.flatten().tolist()
    linear, offset = qubo.linear.tolist(), qubo.offset.item()
    return torch.tensor(
        [
            offset
            + sum(a * x for a, x in zip(linear, state, strict=True))
            + sum(j * state[first] * state[second] for j, (first, second) in zip(coupling, edges, strict=True))
            for state in states.tolist()
        ],
        dtype=torch.float64,
    )


def unsatisfied_by_loop(maxsat, states):
    """One problem: the weight of each clause with no true literal, unit clauses included."""
    weight = maxsat.weight.flatten().tolist()
    first = maxsat.first.expand(maxsat.weight.shape).flatten().tolist()
    second = maxsat.second.expand(maxsat.weight.shape).flatten().tolist()
    clauses = list(zip(weight, first, second, maxsat.graph.edges().tolist(), strict=True))

    def total(state):
        literal = {(i, sign): bool(x) == (sign > 0) for i, x in enumerate(state) for sign in (1, -1)}
        broken = sum(w for w, p, q, (i, j) in clauses if not (literal[i, int(p)] or literal[j, int(q)]))
        units = enumerate(maxsat.unit.tolist())
        return broken + sum(abs(u) for i, u in units if u and not literal[i, 1 if u > 0 else -1])

    return torch.tensor([total(state) for state in states.tolist()], dtype=torch.float64)


def close(a, b):
    torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.fixture(params=GRAPHS, ids=str)
def graph(request):
    return GRAPHS[request.param]


every_batch = pytest.mark.parametrize("problems", [(), (3,), (2, 3)], ids=str)


def test_energy_is_the_sum_of_its_terms(graph):
    qubo = problem(graph)
    close(qubo.energy(all_states(qubo)), energies_by_loop(qubo, all_states(qubo)))


@every_batch
def test_round_trip_keeps_every_energy(graph, problems):
    qubo = problem(graph, problems)
    back = to_qubo(from_qubo(qubo))
    close(back.energy(all_states(qubo)), qubo.energy(all_states(qubo)))
    close(back.offset, qubo.offset)
    close(back.coupling, qubo.coupling)


@every_batch
def test_unsatisfied_weight_and_offset_are_the_energy(graph, problems):
    qubo = problem(graph, problems)
    maxsat = from_qubo(qubo)
    states = all_states(qubo)
    unsatisfied = maxsat.unsatisfied_weight(states)
    close(unsatisfied + maxsat.offset.unsqueeze(-1), qubo.energy(states))
    assert unsatisfied.min() >= 0
    assert maxsat.weight.min() >= 0


def test_unsatisfied_weight_counts_clause_by_clause(graph):
    qubo = problem(graph)
    maxsat = from_qubo(qubo)
    close(maxsat.unsatisfied_weight(all_states(qubo)), unsatisfied_by_loop(maxsat, all_states(qubo)))


def random_maxsat(graph, problems=()):
    """Every combination of polarities."""
    shape = (*problems, *graph.edge_shape)
    return WeightedMaxSat(
        graph=graph,
        weight=normal(*shape, seed=1).abs(),
        first=normal(*shape, seed=2).sign(),
        second=normal(*shape, seed=3).sign(),
        unit=normal(*problems, graph.n, seed=4),
        offset=normal(*problems, seed=5),
    )


def test_unsatisfied_weight_of_any_polarities_counts_clause_by_clause(graph):
    maxsat = random_maxsat(graph)
    states = binary_states(graph.n, like=maxsat.unit)
    close(maxsat.unsatisfied_weight(states), unsatisfied_by_loop(maxsat, states))


@every_batch
def test_qubo_of_any_maxsat_has_its_unsatisfied_weights_as_energies(graph, problems):
    maxsat = random_maxsat(graph, problems)
    qubo = to_qubo(maxsat)
    expected = maxsat.unsatisfied_weight(all_states(qubo)) + maxsat.offset.unsqueeze(-1)
    close(qubo.energy(all_states(qubo)), expected)
    close(to_qubo(from_qubo(qubo)).energy(all_states(qubo)), expected)


@every_batch
def test_field_is_the_energy_difference_of_a_flip(graph, problems):
    qubo = problem(graph, problems)
    states = all_states(qubo)
    field = qubo.field(states)
    for i in range(qubo.n):
        on, off = states.clone(), states.clone()
        on[..., i], off[..., i] = 1, 0
        close(field[..., i], qubo.energy(on) - qubo.energy(off))


def test_bipartite_and_edge_list_layouts_agree():
    qubo = problem(Bipartite(5, 3), (2,))
    edges = EdgeList(n=8, pairs=qubo.graph.edges())
    listed = Qubo(edges, qubo.coupling.flatten(-2), qubo.linear, qubo.offset)
    states = all_states(qubo)
    close(listed.energy(states), qubo.energy(states))
    close(listed.field(states), qubo.field(states))
    a, b = normal(2, 3, 5, seed=6), normal(2, 3, 5, seed=7)
    close(edges.scatter(a.flatten(-2), b.flatten(-2)), qubo.graph.scatter(a, b))
    x = normal(2, 8, seed=8)
    for ours, theirs in zip(edges.gather(x), qubo.graph.gather(x), strict=True):
        close(ours, theirs.expand(2, 3, 5).flatten(-2))


def test_blocks_cover_all_variables_and_hold_no_pair(graph):
    blocks = [range(graph.n)[block] for block in graph.blocks()]
    assert sorted(itertools.chain(*blocks)) == list(range(graph.n))
    block_of = {i: number for number, block in enumerate(blocks) for i in block}
    assert all(block_of[i] != block_of[j] for i, j in graph.edges().tolist())


@every_batch
def test_problem_of_an_asymmetric_matrix_is_its_quadratic_form(problems):
    matrix, offset = normal(*problems, 7, 7, seed=1), normal(*problems, seed=2)
    matrix[..., 2, 5] = matrix[..., 5, 2] = 0
    qubo = Qubo.from_matrix(matrix, offset)
    states = all_states(qubo)
    expected = torch.einsum("...si,...ij,...sj->...s", states, matrix, states) + offset.unsqueeze(-1)
    close(qubo.energy(states), expected)
    assert [2, 5] not in qubo.graph.edges().tolist()


@every_batch
def test_matrix_round_trip(problems):
    matrix = normal(*problems, 7, 7, seed=1)
    qubo = Qubo.from_matrix(matrix)
    upper = matrix.triu() + matrix.tril(-1).mT
    close(qubo.to_matrix(), upper)
    close(Qubo.from_matrix(qubo.to_matrix()).to_matrix(), upper)
    assert not qubo.offset.any()


def test_matrix_of_a_bipartite_problem_has_its_energies():
    qubo = problem(Bipartite(5, 3), (2,))
    again = Qubo.from_matrix(qubo.to_matrix(), qubo.offset)
    close(again.energy(all_states(qubo)), qubo.energy(all_states(qubo)))


@every_batch
@pytest.mark.parametrize("sizes", [(7, 5), (5, 7)], ids=str)
def test_problem_of_a_model_has_its_energies(problems, sizes):
    rbm = small_rbm(*sizes, replicas=problems).double()
    qubo = from_model(rbm)
    states = all_states(qubo)
    v, h = states.split(sizes, dim=-1)
    assert qubo.problems == problems
    close(qubo.energy(states), rbm.energy(v, h).detach())


def test_problem_of_a_model_does_not_reach_back_into_it():
    assert not from_model(small_rbm()).coupling.requires_grad


def test_energies_are_float64_for_float32_problems():
    qubo = Qubo.from_matrix(normal(7, 7, seed=1).float())
    states = all_states(qubo)
    assert qubo.energy(states).dtype == torch.float64
    maxsat = from_qubo(qubo)
    assert maxsat.unsatisfied_weight(states).dtype == torch.float64
    difference = maxsat.unsatisfied_weight(states) + maxsat.offset - qubo.energy(states)
    assert difference.abs().max() < 1e-5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coupling": torch.zeros(5, 3)}, r"coupling shape = \(5, 3\) .* expected \(\*problems, 3, 5\)"),
        ({"linear": torch.zeros(7)}, r"linear shape = \(7,\) .* expected \(8,\)"),
        ({"offset": torch.zeros(2)}, r"offset shape = \(2,\) .* expected \(\)"),
        ({"linear": torch.full((8,), torch.nan)}, "linear = 'a tensor with NaN .* expected finite numbers"),
        ({"coupling": torch.full((3, 5), torch.inf)}, "coupling = .* expected finite numbers"),
    ],
)
def test_error_names_shape_and_allowed(change, message):
    parts = {"coupling": torch.zeros(3, 5), "linear": torch.zeros(8), "offset": torch.zeros(())} | change
    with pytest.raises(SettingError, match=message):
        Qubo(Bipartite(5, 3), **parts)


@pytest.mark.parametrize("shape", [(5,), (5, 7)])
def test_error_names_shape_of_a_matrix_that_is_not_square(shape):
    with pytest.raises(SettingError, match=r"matrix shape = .* expected .*problems, n, n"):
        Qubo.from_matrix(torch.zeros(shape))
