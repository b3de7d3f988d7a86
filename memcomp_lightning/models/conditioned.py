"""A model given some of its visible units, and at another temperature: models of the same kind."""

import copy
from typing import TypeVar

import torch
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.observed import check_mask
from memcomp_lightning.models.rbm import RBM

ModelT = TypeVar("ModelT", bound=EnergyModel)


@torch.no_grad()
def conditioned(model: RBM, v: Tensor, observed: Tensor) -> RBM:
    r"""The RBM of the visible units that are not known, given those that are.

    .. math:: E(v_{rest}, h | v_{known}) = E(v, h) + \mathrm{const}, \qquad c' = c + W_{known} v_{known}

    The known units act on the hidden ones as a bias; nothing else changes.

    Args:
        model: Without replica axes.
        v: What is known, ``(n_visible,)``; other values there are not read.
        observed: Where it is known, a mask of this shape; whole sites, not all of them.

    Raises:
        SettingError: The mask has another shape, hides half a site, or leaves nothing.

    >>> rbm = RBM(3, 2)
    >>> conditioned(rbm, torch.ones(3), torch.tensor([True, False, True])).n_visible
    1
    """
    check_mask(model, v.unsqueeze(0), observed.unsqueeze(0))
    rest = (~observed).nonzero().flatten()
    require(len(rest) > 0, "visible units that are not known", 0, "one or more")
    made = RBM(visible=model.visible.select(rest), hidden=copy.deepcopy(model.hidden)).to(model.b)
    made.weight.copy_(model.weight[:, rest])
    made.b.copy_(model.b[rest])
    made.c.copy_(model.c + model.weight @ torch.where(observed, v, 0.0))
    return made


@torch.no_grad()
def tempered(model: ModelT, beta: float) -> ModelT:
    r"""The model at an inverse temperature, as one of its own: :math:`p_\beta(v, h) \propto \mu e^{-\beta E}`.

    ``beta`` multiplies couplings and biases. The measures :math:`\mu` of the units stay: a real unit keeps its
    precision, so that its mean given the field moves with beta, and its spread around that mean does not.

    >>> bool(tempered(RBM(3, 2), 0.0).weight.any())
    False
    """
    made = copy.deepcopy(model)
    for name, parameter in made.named_parameters():
        if "." not in name:  # the others are the units' own
            parameter.mul_(beta)
    return made
