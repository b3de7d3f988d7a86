"""An energy model as a QUBO. The paper maximises x'Qx (E = -x'Qx); the minus sign lives here alone."""

from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.problems.graph import Bipartite, EdgeList, Graph
from memcomp_lightning.problems.qubo import Qubo


def from_model(model: EnergyModel) -> Qubo:
    """Return the problem whose energy at x = (v, h) is E(v, h) of the model, one problem a replica.

    >>> import torch
    >>> from memcomp_lightning.models import RBM
    >>> rbm = RBM(n_visible=3, n_hidden=2)
    >>> from_model(rbm).energy(torch.ones(1, 5)).allclose(rbm.energy(torch.ones(1, 3), torch.ones(1, 2)).double())
    True
    """
    graph: Graph
    pairs, coupling, bias = model.quadratic_form()
    if pairs is None:
        graph = Bipartite(n_first=model.n_visible, n_second=model.n_hidden)
    else:
        graph = EdgeList(n=bias.shape[-1], pairs=pairs)
    return Qubo(graph, -coupling.detach(), -bias.detach(), coupling.new_zeros(model.replicas))
