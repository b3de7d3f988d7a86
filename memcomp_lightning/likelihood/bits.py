"""Spins as bits: an RBM of units in {0, 1} with the same energies, for what is made for these."""

from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning.errors import SettingError
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.units import Bernoulli


class InBits(NamedTuple):
    """An RBM of units in {0, 1} and what its energies lack.

    Attributes:
        rbm: In float64 where it is another model than the given one.
        offset: E of the given model less that of this one, in corresponding states, ``(*replicas,)`` float64.
    """

    rbm: RBM
    offset: Tensor


@torch.no_grad()
def in_bits(model: RBM) -> InBits | None:
    """Write an RBM in bits, if each unit of it has two values; None if not."""
    zero = model.b.new_zeros(model.replicas, dtype=torch.float64)
    if type(model.visible) is Bernoulli and type(model.hidden) is Bernoulli:
        return InBits(model, zero)
    if model.visible.real or model.hidden.real:
        return None
    try:
        visible, hidden = model.visible.bits(), model.hidden.bits()
    except SettingError:  # a kind of one's own need not have any
        return None
    if visible.groups or hidden.groups:
        return None
    like = zero
    low_v, width_v, low_h, width_h = (x.to(like) for x in (visible.low, visible.width, hidden.low, hidden.width))
    weight, b, c = (x.detach().double() for x in (model.weight, model.b, model.c))
    of_v, of_h = b + low_h @ weight, c + weight @ low_v
    rbm = RBM(model.n_visible, model.n_hidden, replicas=model.replicas).double().to(model.b.device)
    rbm.weight.copy_(weight * width_h.unsqueeze(-1) * width_v)
    rbm.b.copy_(of_v * width_v)
    rbm.c.copy_(of_h * width_h)
    return InBits(rbm, -((of_v * low_v).sum(-1) + (c * low_h).sum(-1)))
