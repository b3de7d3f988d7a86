"""An energy model as a QUBO. The paper maximises x'Qx (E = -x'Qx); the minus sign lives here alone."""

import torch

from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.qubo.graph import Bipartite
from memcomp_lightning.qubo.qubo import Qubo


def from_model(rbm: RBM) -> Qubo:
    """Return the problem whose energy at x = (v, h) is E(v, h) of the RBM, one problem a replica.

    >>> rbm = RBM(n_visible=3, n_hidden=2)
    >>> from_model(rbm).energy(torch.ones(1, 5)).allclose(rbm.energy(torch.ones(1, 3), torch.ones(1, 2)).double())
    True
    """
    weight, b, c = rbm.weight.detach(), rbm.b.detach(), rbm.c.detach()
    return Qubo(
        graph=Bipartite(n_first=rbm.n_visible, n_second=rbm.n_hidden),
        coupling=-weight,
        linear=-torch.cat((b, c), dim=-1),
        offset=weight.new_zeros(rbm.replicas),
    )
