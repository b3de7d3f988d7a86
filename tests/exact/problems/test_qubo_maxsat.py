"""QUBO and weighted MAX-SAT over all states."""

import dataclasses
import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Bipartite, EdgeList, Qubo, WeightedMaxSat, from_model, from_qubo, to_qubo
from memcomp_lightning.problems.maxsat import Clauses
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


# --- two encodings of a coupling --------------------------------------------------------------------------


def test_pairs_alternate_between_two_encodings(graph):
    """J > 0: both literals negated, or neither; J < 0: one of the two."""
    maxsat, qubo = from_qubo(problem(graph)), problem(graph)
    first, second = (x.expand(maxsat.weight.shape).flatten() for x in (maxsat.first, maxsat.second))
    coupling = qubo.coupling.flatten()
    assert (first * second == torch.where(coupling < 0, -1, 1)).all()
    assert second.tolist() == (-graph.alternating()).ravel().tolist()
    assert set(second.tolist()) == {-1, 1}


def test_encodings_of_either_kind_keep_every_energy(graph, monkeypatch):
    """Whatever the pattern of the two encodings, also all of one kind."""
    qubo = problem(graph, (2,))
    for pattern in (1.0, -1.0, normal(*graph.edge_shape, seed=6).sign()):
        way = pattern * torch.ones(graph.edge_shape)
        monkeypatch.setattr(type(graph), "alternating", lambda self, way=way: way)
        maxsat = from_qubo(qubo)
        close(maxsat.energy(all_states(qubo)), qubo.energy(all_states(qubo)))
        close(to_qubo(maxsat).linear, qubo.linear)
        assert maxsat.weight.equal(qubo.coupling.abs())


def test_signs_of_the_encodings_balance(graph):
    """In a list as a whole, between two layers at every variable."""
    signs = torch.as_tensor(graph.alternating())
    assert tuple(signs.shape) == graph.edge_shape
    assert signs.sum().abs() <= 1
    if isinstance(graph, Bipartite):
        assert (graph.scatter(signs, signs).abs() <= 1).all()


def cut_problem(n, pairs):
    """MAX-CUT of an unweighted graph: every cut edge counts -1."""
    pairs = torch.tensor(pairs)
    degree = torch.bincount(pairs.flatten(), minlength=n).double()
    weights = torch.full((len(pairs),), 2.0, dtype=torch.float64)
    return Qubo(EdgeList(n=n, pairs=pairs), weights, -degree, torch.zeros((), dtype=torch.float64)), degree


CUTS = {
    "complete graph": (15, list(itertools.combinations(range(15), 2))),
    "ring": (11, [(i, i + 1) for i in range(10)] + [(0, 10)]),
    "star": (11, [(0, i) for i in range(1, 11)]),
    "grid": (
        20,
        sorted(
            [(5 * r + c, 5 * r + c + 1) for r in range(4) for c in range(4)]
            + [(5 * r + c, 5 * r + c + 5) for r in range(3) for c in range(5)]
        ),
    ),
}


@pytest.mark.parametrize("name", CUTS)
def test_units_nearly_cancel_on_max_cut(name):
    """The clauses of a vertex weigh twice its degree; its unit clause weighs no more than half of that."""
    qubo, degree = cut_problem(*CUTS[name])
    unit = from_qubo(qubo).unit
    assert (unit.abs() <= degree).all()
    assert unit.square().mean() < 0.3 * degree.square().mean()
    assert unit.sum().abs() <= 0.2 * degree.sum()


# --- clauses of any length --------------------------------------------------------------------------------

LITERALS = [
    [1, -2, 3],
    [2, -3],
    [-4],
    [5, 5, -1],
    [1, -1, 2],
    [4, -4],
    [],
    [3],
    [-3],
    [3],
    [-3, 1, -5, 2],
    [2, -3],
]
WEIGHTS = [1.0, 2.5, 0.7, 1.1, 9.0, 3.0, 0.4, 5.0, 2.0, 0.25, 1.3, 0.5]


def clauses_by_loop(literals, weights, states):
    """The weight of the clauses with no true literal, state by state."""
    return torch.tensor(
        [
            sum(
                w
                for clause, w in zip(literals, weights, strict=True)
                if not any(x[abs(q) - 1] == (q > 0) for q in clause)
            )
            for x in (states > 0.5).tolist()
        ],
        dtype=torch.float64,
    )


def random_clauses(n, number, seed):
    """Clauses of 0 to 6 literals, drawn with repetition: duplicates, opposites and tautologies among them."""
    generator = rng.stream(seed, "clauses")
    lengths = torch.randint(7, (number,), generator=generator).tolist()
    signs = [torch.randint(2, (length,), generator=generator) * 2 - 1 for length in lengths]
    literals = [
        (torch.randint(1, n + 1, (length,), generator=generator) * sign).tolist()
        for length, sign in zip(lengths, signs, strict=True)
    ]
    return literals, (3 * rng.uniform((number,), generator=generator)).tolist()


@pytest.mark.parametrize(
    ("n", "literals", "weights"),
    [(5, LITERALS, WEIGHTS), *((n, *random_clauses(n, 60, seed=n)) for n in (1, 2, 5, 9))],
    ids=["by hand", "1", "2", "5", "9"],
)
def test_clauses_weigh_what_was_given(n, literals, weights):
    maxsat = WeightedMaxSat.from_clauses(n, literals, weights, offset=0.3)
    states = binary_states(n, like=maxsat.unit)
    energies = torch.as_tensor(maxsat.energy(states))
    close(energies, clauses_by_loop(literals, weights, states) + 0.3)
    close(torch.as_tensor(maxsat.unsatisfied_weight(states) + maxsat.offset), energies)


def test_parts_of_a_problem_by_hand():
    maxsat = WeightedMaxSat.from_clauses(5, LITERALS, WEIGHTS, offset=0.3)
    assert maxsat.unit.tolist() == [0.0, 0.0, 3.25, -0.7, 0.0]
    assert maxsat.offset.item() == pytest.approx(0.3 + 0.4 + 2.0)  # the empty clause; 2 of the opposite units
    assert maxsat.graph.pairs.tolist() == [[1, 2], [0, 4], [1, 2]]  # [5, 5, -1] is [-1, 5]
    assert maxsat.weight.tolist() == [2.5, 1.1, 0.5]
    assert np.stack((maxsat.first, maxsat.second), -1).tolist() == [[1, -1], [-1, 1], [1, -1]]
    assert [block.variables.tolist() for block in maxsat.longer] == [[[0, 1, 2]], [[0, 1, 2, 4]]]
    assert [block.polarity.tolist() for block in maxsat.longer] == [[[1, -1, 1]], [[1, 1, -1, -1]]]
    assert [block.weight.tolist() for block in maxsat.longer] == [[1.0], [1.3]]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_problem_without_clauses(dtype):
    maxsat = WeightedMaxSat.from_clauses(3, [], [], offset=2.0, dtype=dtype)
    assert maxsat.energy(binary_states(3, like=maxsat.unit)).tolist() == [2.0] * 8
    assert maxsat.unit.dtype == maxsat.weight.dtype == dtype


def test_tautologies_are_left_out():
    maxsat = WeightedMaxSat.from_clauses(4, [[1, -1], [2, 3, -2], [1, 2, 3, 4, -3]], [1.0, 2.0, 3.0])
    assert maxsat.graph.pairs.shape == (0, 2)
    assert not maxsat.longer
    assert maxsat.energy(torch.zeros(1, 4)).tolist() == [0.0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((2, [[1], [2]], [1.0]), "number of weights = 1 .* expected 2, one a clause"),
        ((2, [[1], [-2]], [1.0, -0.5]), r"weight of clause 2 = -0.5 .* expected a number >= 0"),
        ((2, [[1], [-2]], [1.0, math.nan]), r"weight of clause 2 = nan .* expected a number >= 0"),
        ((2, [[1, 3]], [1.0]), r"literals of clause 1 = \[1, 3\] .* integers of size 1 to n = 2"),
        ((2, [[1], [0, 1]], [1.0, 1.0]), r"literals of clause 2 = \[0, 1\] .* integers of size 1 to n = 2"),
    ],
)
def test_clauses_out_of_range_are_refused(arguments, message):
    with pytest.raises(SettingError, match=message):
        WeightedMaxSat.from_clauses(*arguments)


def longer_maxsat(graph, problems=()):
    """Random pairs and units, and clauses of three to five literals."""

    def block(length, number):
        draw = normal(number, graph.n, seed=30 + length).argsort(-1)[:, :length]
        polarity = normal(number, length, seed=40 + length).sign()
        return Clauses(draw, polarity, normal(*problems, number, seed=50 + length).abs())

    return dataclasses.replace(random_maxsat(graph, problems), longer=(block(3, 6), block(4, 3), block(5, 2)))


@every_batch
@pytest.mark.parametrize("make", [random_maxsat, longer_maxsat])
def test_field_of_maxsat_is_the_energy_difference_of_a_flip(graph, problems, make):
    maxsat = make(graph, problems)
    states = binary_states(graph.n, like=maxsat.unit).expand(*problems, -1, -1)
    field = maxsat.field(states)
    assert field.shape == states.shape
    assert field.dtype == torch.float64
    for i in range(graph.n):
        on, off = states.clone(), states.clone()
        on[..., i], off[..., i] = 1, 0
        close(field[..., i], maxsat.energy(on) - maxsat.energy(off))


@every_batch
def test_longer_clauses_add_to_the_rest(graph, problems):
    maxsat = longer_maxsat(graph, problems)
    states = binary_states(graph.n, like=maxsat.unit).expand(*problems, -1, -1)
    longer = sum(block.unsatisfied_weight(states) for block in maxsat.longer)
    assert longer.shape == (*problems, 2**graph.n)
    close(maxsat.energy(states), maxsat.without_longer().energy(states) + longer)
    if not problems:
        rows = [
            ((sign * (variable + 1)).int().tolist(), weight)
            for block in maxsat.longer
            for variable, sign, weight in zip(block.variables, block.polarity, block.weight.tolist(), strict=True)
        ]
        close(longer, clauses_by_loop([row for row, _ in rows], [weight for _, weight in rows], states))


def test_energy_of_boolean_states():
    maxsat, qubo = longer_maxsat(SPARSE), problem(SPARSE)
    states = binary_states(7, like=maxsat.unit)
    assert maxsat.energy(states > 0.5).equal(maxsat.energy(states))
    assert qubo.energy(states > 0.5).equal(qubo.energy(states))


# --- layouts and sources ----------------------------------------------------------------------------------


def test_bipartite_and_edge_list_layouts_agree():
    qubo = problem(Bipartite(5, 3), (2,))
    edges = EdgeList(n=8, pairs=torch.as_tensor(qubo.graph.edges()))
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


@every_batch
def test_problem_of_a_list_of_entries_is_its_sum(problems):
    """Duplicates, both orders of a pair, and diagonal entries add up."""
    rows = torch.tensor([0, 3, 3, 1, 4, 0, 2, 2, 6, 3])
    columns = torch.tensor([3, 0, 3, 5, 1, 3, 2, 2, 5, 3])
    values, offset = normal(*problems, 10, seed=1), normal(*problems, seed=2)
    qubo = Qubo.from_coo(7, rows, columns, values, offset)
    assert qubo.graph.edges().tolist() == [[0, 3], [1, 4], [1, 5], [5, 6]]
    states = all_states(qubo)
    expected = (values.unsqueeze(-2) * states[..., rows] * states[..., columns]).sum(-1) + offset.unsqueeze(-1)
    close(qubo.energy(states), expected)
    order = torch.randperm(10, generator=rng.stream(0, "order"))
    again = Qubo.from_coo(7, columns[order], rows[order], values[..., order], offset)
    assert again.graph.edges().equal(qubo.graph.edges())
    close(again.coupling, qubo.coupling)
    close(again.linear, qubo.linear)


def test_entries_that_cancel_keep_their_pair():
    index = torch.tensor([[0, 1], [1, 0]])
    qubo = Qubo.from_coo(3, index[0], index[1], torch.tensor([2.0, -2.0]))
    assert qubo.energy(torch.ones(1, 3)).tolist() == [0.0]
    assert qubo.coupling.tolist() == [0.0]


def test_no_entries():
    none = torch.zeros(0, dtype=torch.int64)
    assert Qubo.from_coo(3, none, none, torch.zeros(0)).energy(torch.ones(1, 3)).tolist() == [0.0]


@pytest.mark.parametrize(
    ("rows", "columns", "message"),
    [
        ([0, 3], [1, 1], r"rows = 'shape \(2,\), from 0 to 3' .* 2 integers, one a value, from 0 to n - 1 = 2"),
        ([0, 1], [1, -1], r"columns = 'shape \(2,\), from -1 to 1' .*"),
        ([0, 1, 2], [1, 1, 1], r"rows = 'shape \(3,\), .* 2 integers"),
    ],
)
def test_entries_out_of_range_are_refused(rows, columns, message):
    with pytest.raises(SettingError, match=message):
        Qubo.from_coo(3, torch.tensor(rows), torch.tensor(columns), torch.ones(2))


@pytest.mark.filterwarnings("ignore:Sparse CS. tensor support is in beta")
@pytest.mark.parametrize("layout", [torch.sparse_coo, torch.sparse_csr, torch.sparse_csc], ids=str)
def test_problem_of_a_sparse_tensor_is_that_of_the_dense_one(layout):
    matrix = normal(7, 7, seed=1)
    matrix[normal(7, 7, seed=2) > 0] = 0
    offset = torch.tensor(0.5, dtype=torch.float64)
    dense, sparse = Qubo.from_matrix(matrix, offset), Qubo.from_matrix(matrix.to_sparse(layout=layout), offset)
    assert sparse.graph.edges().equal(dense.graph.edges())
    assert sparse.coupling.equal(dense.coupling)
    assert sparse.linear.equal(dense.linear)
    assert sparse.offset.equal(dense.offset)


def test_entries_of_an_uncoalesced_tensor_add_up():
    index = torch.tensor([[0, 0, 1, 2], [1, 1, 0, 2]])
    matrix = torch.sparse_coo_tensor(index, torch.tensor([1.0, 2.0, 4.0, 8.0]), (3, 3), check_invariants=True)
    qubo = Qubo.from_matrix(matrix)
    assert qubo.coupling.tolist() == [7.0]
    assert qubo.linear.tolist() == [0.0, 0.0, 8.0]


def test_several_sparse_matrices_at_once_are_refused():
    with pytest.raises(SettingError, match=r"sparse matrix shape = \(2, 3, 3\) .* \(n, n\), one problem"):
        Qubo.from_matrix(torch.zeros(2, 3, 3).to_sparse())


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
        ({"linear": torch.full((8,), torch.nan)}, "linear = 'an array with NaN .* expected finite numbers"),
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


# ------------------------------------------------------------------------------------------------ without rounding


def test_weights_that_are_integers_or_fractions_add_up_without_rounding():
    clauses, weights = [[1]] * 101 + [[-1]], [2**54, *[3] * 100, 2**54 + 299]
    problem = WeightedMaxSat.from_clauses(1, clauses, weights)
    assert problem.unit.tolist() == [1.0]
    thirds = WeightedMaxSat.from_clauses(1, [[1]] * 3 + [[-1]], [Fraction(1, 3)] * 3 + [1])
    assert thirds.unit.tolist() == [0.0]
    assert thirds.offset.item() == 1.0


def test_integers_stay_integers_and_have_the_energies_of_the_clauses():
    clauses, weights = [[1, 2], [-1, 2], [1, -2], [-1, -2], [2], [-3], []], [2**60, 3, 2**59 + 1, 5, 7, 11, 13]
    qubo = to_qubo(WeightedMaxSat.from_clauses(3, clauses, weights, dtype=np.int64))
    assert {part.dtype for part in (qubo.coupling, qubo.linear, qubo.offset)} == {np.dtype(np.int64)}
    for x in itertools.product((0, 1), repeat=3):
        false = [not any((x[abs(q) - 1] == 1) == (q > 0) for q in clause) for clause in clauses]
        expected = sum(w for w, is_false in zip(weights, false, strict=True) if is_false)
        assert qubo.energy(np.array([x])).tolist() == [expected]
