"""An energy model as a QUBO. The paper maximises x'Qx (E = -x'Qx); the minus sign lives here alone."""

from typing import TYPE_CHECKING

from memcomp_lightning.arrays import Array, namespace
from memcomp_lightning.problems.graph import Bipartite, EdgeList, Graph
from memcomp_lightning.problems.qubo import Qubo

if TYPE_CHECKING:
    from memcomp_lightning.models.base import EnergyModel


def from_model(model: "EnergyModel") -> Qubo:
    """Return the problem whose energy at x = (v, h) is E(v, h) of the model, one problem a replica.

    >>> import torch
    >>> from memcomp_lightning.models import RBM
    >>> rbm = RBM(n_visible=3, n_hidden=2)
    >>> from_model(rbm).energy(torch.ones(1, 5)).allclose(rbm.energy(torch.ones(1, 3), torch.ones(1, 2)).double())
    True
    """
    pairs, coupling, bias = model.quadratic_form()
    layers = Bipartite(n_first=model.n_visible, n_second=model.n_hidden)
    graph: Graph = layers if pairs is None else EdgeList(n=bias.shape[-1], pairs=pairs)
    return from_quadratic_form(graph, coupling.detach(), bias.detach())


def from_quadratic_form(graph: Graph, coupling: Array, bias: Array) -> Qubo:
    """Return the problem of the energy ``-sum_pairs coupling x_i x_j - bias . x``."""
    axes = coupling.ndim - len(graph.edge_shape)
    offset = namespace(bias).zeros(coupling.shape[:axes], dtype=bias.dtype, device=bias.device)
    return Qubo(graph, -coupling, -bias, offset)
