"""Boltzmann machines of any connectivity against RBMs, dense matrices and enumeration."""

import sys

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.interop import annealer_graph
from memcomp_lightning.models import DBM, DBN, RBM, BoltzmannMachine, Normal, mean_field
from memcomp_lightning.models.connectivity import colouring, from_graph, from_mask, from_pairs, full, grid, layered
from memcomp_lightning.objective import Centring, contrast
from memcomp_lightning.types import Configurations


def machine(n_visible=5, n_hidden=3, connectivity=None, replicas=(), std=0.8):
    generator = rng.stream(0, "weights")
    made = BoltzmannMachine(
        n_visible, n_hidden, connectivity, replicas=replicas, weight_init=Normal(std=std), generator=generator
    )
    return randomised(made)


def randomised(model):
    generator = rng.stream(1, "biases")
    with torch.no_grad():
        for bias in (model.b, model.c):
            bias.normal_(0.2, 0.5, generator=generator)
    return model.double()


def dense(model):
    """The symmetric matrix of couplings."""
    n = model.n_units
    matrix = torch.zeros(*model.replicas, n, n, dtype=model.coupling.dtype)
    matrix[..., model.pairs[:, 0], model.pairs[:, 1]] = model.coupling.detach()
    return matrix + matrix.mT


def states(model, n=None):
    v, h = binary_states(model.n_units, like=model.b).split((model.n_visible, model.n_hidden), dim=-1)
    return (v.expand(*model.replicas, *v.shape), h.expand(*model.replicas, *h.shape))


CONNECTIVITIES = {
    "full": None,
    "layers": layered([5, 2, 1]),
    "grid": grid(2, 4),
    "sparse": from_pairs(8, [(7, 0), (1, 3), (4, 2), (2, 1), (5, 6), (6, 7), (0, 4)]),
}


@pytest.mark.parametrize("replicas", [(), (2,), (2, 3)])
@pytest.mark.parametrize("connectivity", CONNECTIVITIES.values(), ids=CONNECTIVITIES)
def test_energy_is_that_of_the_dense_matrix(connectivity, replicas):
    model = machine(connectivity=connectivity, replicas=replicas)
    v, h = states(model)
    x = torch.cat((v, h), dim=-1)
    expected = -0.5 * ((x @ dense(model)) * x).sum(-1) - (x @ model.bias.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(model.energy(v, h), expected)
    for block in model.blocks():
        found = block.field(x)
        torch.testing.assert_close(found, (x @ dense(model) + model.bias.unsqueeze(-2))[..., block.units])
        inside = dense(model)[..., block.units, :][..., block.units]
        assert not inside.any()
    weight = rng.uniform(v.shape[:-1], generator=rng.stream(0, "w")).double() - 0.5
    torch.testing.assert_close(model.total_energy(v, h, weight), (weight * expected).sum(-1))


def test_an_rbm_as_a_boltzmann_machine():
    rbm = randomised(RBM(5, 3, replicas=(2,), weight_init=Normal(std=1.0)))
    same = BoltzmannMachine(5, 3, layered([5, 3]), replicas=(2,)).double()
    with torch.no_grad():
        same.coupling.copy_(rbm.weight.mT.flatten(-2))
        same.b.copy_(rbm.b)
        same.c.copy_(rbm.c)
    assert [units.tolist() for units in same.classes] == [[0, 1, 2, 3, 4], [5, 6, 7]]
    v, h = states(same)
    torch.testing.assert_close(same.energy(v, h), rbm.energy(v, h))
    torch.testing.assert_close(same.hidden_mean(v), rbm.hidden_mean(v))
    positive, negative = Configurations(v[:, :11], h[:, :11]), Configurations(v[:, 50:], h[:, 50:])
    offsets = Centring().follow(None, positive)
    for given in (None, offsets):
        of_same, of_rbm = (
            torch.autograd.grad(contrast(model, positive, negative, given).sum(), list(model.parameters()))
            for model in (same, rbm)
        )
        torch.testing.assert_close(of_same[0].unflatten(-1, (5, 3)).mT, of_rbm[0])
        torch.testing.assert_close(of_same[1:], of_rbm[1:])


def test_a_dbm_is_its_dbn_in_one_energy():
    dbm, dbn = (
        kind(5, [3, 2, 4], weight_init=Normal(std=1.0), generator=rng.stream(7, "weights")) for kind in (DBM, DBN)
    )
    for weight, rbm in zip(dbm.weights(), dbn, strict=True):
        torch.testing.assert_close(weight, rbm.weight)
    for rbm in dbn:
        randomised(rbm)
    dbm.double().take(dbn)
    v, h = states(dbm)
    layers = (v, *dbm.hidden_layers(h))
    expected = sum(rbm.energy(*layers[at : at + 2]) for at, rbm in enumerate(dbn))
    torch.testing.assert_close(dbm.energy(v, h), expected)
    assert len(dbm.classes) == 2
    other = DBN(5, [3, 2, 4]).double()
    dbm.give(other)
    taken = DBM(5, [3, 2, 4]).double()
    taken.take(other)
    torch.testing.assert_close(list(taken.parameters()), list(dbm.parameters()))
    with pytest.raises(SettingError, match=r"sizes of the DBN = \(5, 3\)"):
        dbm.take(DBN(5, [3]))


@pytest.mark.parametrize("connectivity", CONNECTIVITIES.values(), ids=CONNECTIVITIES)
def test_gradient_is_that_of_the_enumerated_likelihood(connectivity):
    """With the exact phases, mean over the data of -log p(v) and the contrast have one gradient."""
    model = machine(connectivity=connectivity)
    v, h = states(model)
    data = v[::31]
    n_hidden = 2**model.n_hidden

    def joint(v):
        """Every hidden state beside each row."""
        all_h = binary_states(model.n_hidden, like=v)
        return v.repeat_interleave(n_hidden, dim=0), all_h.repeat(len(v), 1)

    clamped = joint(data)
    log_joint = -model.energy(*clamped).view(-1, n_hidden)
    loss = -(log_joint.logsumexp(-1).mean() - (-model.energy(v, h)).logsumexp(-1))
    expected = torch.autograd.grad(loss, list(model.parameters()))
    positive = Configurations(*clamped, log_joint.softmax(-1).flatten().detach())
    negative = Configurations(v, h, (-model.energy(v, h)).softmax(-1).detach())
    found = torch.autograd.grad(contrast(model, positive, negative), list(model.parameters()))
    torch.testing.assert_close(found, expected)
    offsets = Centring().follow(None, positive)
    surrogate = contrast(model, positive, negative, offsets)
    torch.testing.assert_close(surrogate, contrast(model, positive, negative))


def test_mean_field_is_exact_without_couplings_between_hidden_units():
    model = machine(connectivity=layered([5, 3]), replicas=(2,))
    v, _ = states(model)
    solution = mean_field(model, v)
    assert (solution.n_iterations, solution.converged.tolist(), solution.change.tolist()) == (
        1,
        [True] * 2,
        [0] * 2,
    )
    field = (v @ dense(model)[..., :5, 5:]) + model.c.unsqueeze(-2)
    torch.testing.assert_close(solution.h, field.sigmoid())


def test_mean_field_converges_to_its_fixed_point_or_says_that_it_did_not():
    model = machine(n_hidden=4, replicas=(2,))
    v = states(model)[0][..., ::37, :]
    solution = mean_field(model, v, max_iterations=1000, tolerance=1e-12)
    assert bool(solution.converged.all())
    x = torch.cat((v, solution.h), dim=-1)
    field = (x @ dense(model) + model.bias.unsqueeze(-2))[..., 5:]
    torch.testing.assert_close(solution.h, field.sigmoid())
    hasty = mean_field(model, v, max_iterations=2, tolerance=1e-12)
    assert (hasty.n_iterations, bool(hasty.converged.any())) == (2, False)
    assert bool((hasty.change > 0).all())


@pytest.mark.parametrize(
    ("n_units", "pairs", "n_classes"),
    [(8, full(8), 8), (784 + 500 + 7, layered([784, 500, 7]), 2), (35, grid(5, 7), 2), (3, full(3)[:0], 1)],
    ids=["full", "layers", "grid", "no pairs"],
)
def test_colouring(n_units, pairs, n_classes):
    classes = colouring(n_units, pairs)
    assert len(classes) == n_classes
    assert torch.cat(classes).sort().values.equal(torch.arange(n_units))
    colour = torch.empty(n_units, dtype=torch.long)
    for number, units in enumerate(classes):
        colour[units] = number
    assert bool((colour[pairs[:, 0]] != colour[pairs[:, 1]]).all())


def test_graphs_of_annealers():
    networkx = pytest.importorskip("networkx")
    graph = networkx.circulant_graph(20, [1, 5])
    pairs = from_graph(networkx.relabel_nodes(graph, {n: 3 * n for n in graph}))
    assert pairs.shape == (40, 2)
    assert {tuple(pair) for pair in pairs.tolist()} == {tuple(sorted(edge)) for edge in graph.edges}


@pytest.mark.parametrize(
    ("connectivity", "message"),
    [
        (torch.ones(4, 4).triu(1), r"mask = 'asymmetric at \[\[0, 1\]\]'"),
        (torch.ones(4, 4), r"mask = 'unit \[0\] coupled to itself'"),
        (torch.ones(4, 3), "shape of connectivity"),
        ([(0, 1), (1, 0), (2, 3)], r"pair = \[\(0, 1\)\]"),
        ([(0, 4)], r"unit of a pair = \[4\]"),
        ([(-1, 2)], r"unit of a pair = \[-1\]"),
        ([(2, 2)], r"pair = \[\[2, 2\]\]"),
        ([(0, 3), (2, 3)], r"visible unit = \[1\]"),
    ],
)
def test_wrong_connectivity_is_refused(connectivity, message):
    with pytest.raises(SettingError, match=message):
        BoltzmannMachine(3, 1, connectivity)


def test_masks_and_pairs_mean_the_same():
    mask = torch.zeros(5, 5)
    pairs = torch.tensor([(0, 3), (1, 3), (2, 4), (3, 4)])
    mask[pairs[:, 0], pairs[:, 1]] = mask[pairs[:, 1], pairs[:, 0]] = 1
    assert from_mask(mask).equal(pairs)
    assert BoltzmannMachine(3, 2, mask).pairs.equal(BoltzmannMachine(3, 2, pairs.flip(0, 1)).pairs)


@pytest.mark.parametrize(("kind", "size", "n_units"), [("chimera", 2, 32), ("pegasus", 2, 40), ("zephyr", 3, 336)])
def test_visible_units_lie_evenly_on_the_graph_of_an_annealer(kind, size, n_units):
    graphs = pytest.importorskip("dwave.graphs")
    pairs = annealer_graph(kind, size, n_visible=7)
    graph = getattr(graphs, f"{kind}_graph")(size)
    assert (graph.number_of_nodes(), graph.number_of_edges()) == (n_units, len(pairs))
    model = BoltzmannMachine(7, None, pairs)
    assert model.n_units == n_units
    degree = torch.bincount(pairs.flatten(), minlength=n_units)
    degrees = [graph.degree[node] for node in sorted(graph.nodes)]
    assert degree.sort().values.tolist() == sorted(degrees)
    assert degree[:7].tolist() == [degrees[index * n_units // 7] for index in range(7)]
    with pytest.raises(SettingError, match=f"less than the {n_units} units of {kind} graph {size}"):
        annealer_graph(kind, size, n_visible=n_units)


def test_without_dwave_graphs_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "dwave.graphs", None)
    monkeypatch.delattr("dwave.graphs", raising=False)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'memcomp-lightning\[dimod\]'"):
        annealer_graph("zephyr", 2, n_visible=3)
