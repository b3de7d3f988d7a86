"""An energy model as a QUBO. The paper maximises x'Qx (E = -x'Qx); the minus sign lives here alone."""

from typing import TYPE_CHECKING

from memcomp_lightning.arrays import Array, namespace
from memcomp_lightning.problems.constrained import Constrained, exactly
from memcomp_lightning.problems.graph import Bipartite, EdgeList, Graph
from memcomp_lightning.problems.qubo import Qubo

if TYPE_CHECKING:
    from memcomp_lightning.models.base import EnergyModel
    from memcomp_lightning.models.bit_form import BitForm


def from_model(model: "EnergyModel") -> Qubo:
    """Return a model's energy as a QUBO, one problem a replica.

    Of units in {0, 1} the energy at x = (v, h) is E(v, h). Spins are written in bits, the states of a category are
    a bit each, of which exactly one has to be 1 (:func:`constrained_from_model` says so), and real units are
    integrated out: ``models.bit_form`` has the details, and ``models.read_bits`` reads answers.

    Raises:
        SettingError: The model has units without a form in bits.

    >>> import torch
    >>> from memcomp_lightning.models import RBM
    >>> rbm = RBM(n_visible=3, n_hidden=2)
    >>> from_model(rbm).energy(torch.ones(1, 5)).allclose(rbm.energy(torch.ones(1, 3), torch.ones(1, 2)).double())
    True
    """
    return from_bit_form(model.in_bits())


def constrained_from_model(model: "EnergyModel") -> Qubo | Constrained:
    """The same problem, with the constraint of each categorical site as a hard one where there are any."""
    form = model.in_bits()
    constraints = [exactly(1, group) for group in form.groups]
    return Constrained.of(from_bit_form(form), constraints) if constraints else from_bit_form(form)


def from_bit_form(form: "BitForm") -> Qubo:
    """The problem of an energy in bits."""
    pairs, coupling, bias = form.form
    n = bias.shape[-1]
    layers = Bipartite(n_first=form.n_first, n_second=n - form.n_first)
    graph: Graph = layers if pairs is None else EdgeList(n=n, pairs=pairs)
    return Qubo(graph, -coupling.detach(), -bias.detach(), form.offset)


def from_quadratic_form(graph: Graph, coupling: Array, bias: Array) -> Qubo:
    """Return the problem of the energy ``-sum_pairs coupling x_i x_j - bias . x``."""
    axes = coupling.ndim - len(graph.edge_shape)
    offset = namespace(bias).zeros(coupling.shape[:axes], dtype=bias.dtype, device=bias.device)
    return Qubo(graph, -coupling, -bias, offset)
