"""An energy model as a QUBO. The paper maximises x'Qx (E = -x'Qx); the minus sign lives here alone."""

import torch

from memcomp_lightning.models.boltzmann import BoltzmannMachine
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.problems.graph import Bipartite, EdgeList, Graph
from memcomp_lightning.problems.qubo import Qubo


def from_model(model: RBM | BoltzmannMachine) -> Qubo:
    """Return the problem whose energy at x = (v, h) is E(v, h) of the model, one problem a replica.

    >>> rbm = RBM(n_visible=3, n_hidden=2)
    >>> from_model(rbm).energy(torch.ones(1, 5)).allclose(rbm.energy(torch.ones(1, 3), torch.ones(1, 2)).double())
    True
    """
    graph: Graph
    if isinstance(model, BoltzmannMachine):
        graph, coupling = EdgeList(n=model.n_units, pairs=model.pairs), model.coupling
    else:
        graph, coupling = Bipartite(n_first=model.n_visible, n_second=model.n_hidden), model.weight
    linear = torch.cat((model.b, model.c), dim=-1)
    return Qubo(graph, -coupling.detach(), -linear.detach(), coupling.new_zeros(model.replicas))
