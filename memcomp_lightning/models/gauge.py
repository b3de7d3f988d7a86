"""The gauge of categorical units: which of many equal sets of parameters stands for a model."""

import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.boltzmann import BoltzmannMachine
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.units import Units


@torch.no_grad()
def zero_sum(model: RBM | BoltzmannMachine) -> Float[Tensor, "*replicas"]:
    r"""Bring a model into the zero-sum gauge, in place, and return the energy that every state gained by it.

    One entry of a categorical site is 1, so that a number may go from all its couplings to another unit into that
    unit's bias, and from all its biases into a constant: no probability changes. Here, for the couplings of a site
    with the states a to any unit, and for its biases,

    .. math:: \sum_a w_{a} = 0, \qquad \sum_a b_a = 0

    Blocks between two categorical sites add up to zero in both directions. It is the gauge of the least sum of
    squares of the couplings (Ekeberg et al. 2013). Other units have no gauge, and their couplings to each other
    stay. Energies are higher by the number that is returned, and log Z is lower by it.

    The means that the centred gradient subtracts add up to one in each site, and so do the data: the gradient of a
    site's couplings then adds up to zero, and training by plain descent keeps the gauge in which it begins. The
    gradient without centring, adaptive optimisers and L1 leave it. What reports couplings calls this for a copy.

    Raises:
        SettingError: Something other than an RBM or a Boltzmann machine; of a DBN give its RBMs.
    """
    allowed = "an RBM or a Boltzmann machine"
    fits = isinstance(model, RBM | BoltzmannMachine)
    require(fits, "model", type(model).__name__, allowed, "Of a DBN give a layer.")
    visible, hidden = model.visible, model.hidden
    if isinstance(model, RBM):
        weight, to_c, to_b = _doubly(model.weight, hidden, visible)
        model.weight.copy_(weight)
    else:
        pairs, n = model.pairs, model.n_visible
        matrix = model.coupling.new_zeros(*model.replicas, model.n_units, model.n_units)
        matrix[..., pairs[:, 0], pairs[:, 1]] = model.coupling
        matrix, to_first, to_second = _doubly(matrix, *[_Both(visible, hidden)] * 2)
        model.coupling.copy_(matrix[..., pairs[:, 0], pairs[:, 1]])
        to_b, to_c = (to_first + to_second).split([n, model.n_hidden], dim=-1)
    gained = model.b.new_zeros(model.replicas)
    for bias, moved, units in ((model.b, to_b, visible), (model.c, to_c, hidden)):
        whole = bias + moved
        rest = units.zero_sum(whole)
        gained = gained + _taken(whole - rest, units)
        bias.copy_(rest)
    return gained


class _Both:
    """The visible and the hidden units of a machine as one layer."""

    def __init__(self, visible: Units, hidden: Units) -> None:
        self.visible, self.hidden = visible, hidden

    def zero_sum(self, x: Tensor) -> Tensor:
        v, h = x.split([self.visible.n, self.hidden.n], dim=-1)
        return torch.cat((self.visible.zero_sum(v), self.hidden.zero_sum(h)), dim=-1)

    def site_of(self) -> Tensor:
        return torch.cat((self.visible.site_of(), self.hidden.site_of() + self.visible.n_sites))


def _doubly(matrix: Tensor, rows: "Units | _Both", columns: "Units | _Both") -> tuple[Tensor, Tensor, Tensor]:
    """Couplings in the zero-sum gauge of both layers, and what their biases take."""
    of_columns = columns.zero_sum(matrix)
    to_rows = _taken(matrix - of_columns, columns)
    of_both = rows.zero_sum(of_columns.mT).mT
    to_columns = _taken((of_columns - of_both).mT, rows)
    return of_both, to_rows, to_columns


def _taken(constant: Tensor, units: "Units | _Both") -> Tensor:
    """What numbers that are the same in all entries of a site come to, because one entry of each site is 1."""
    site_of = units.site_of().to(constant.device)
    sizes = torch.bincount(site_of)
    return (constant / sizes[site_of]).sum(-1)
