"""Spins as bits: an RBM of units in {0, 1} with the same energies, for what is made for these."""

from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood.boltzmann import double_of
from memcomp_lightning.models.bit_form import bit_form
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
        form = bit_form(double_of(model))
    except SettingError:  # a kind of one's own need not have any
        return None
    if form.groups:
        return None
    coupling, bias = form.form.coupling, form.form.bias
    rbm = RBM(model.n_visible, model.n_hidden, replicas=model.replicas).double().to(model.b.device)
    rbm.weight.copy_(coupling)
    rbm.b.copy_(bias[..., : model.n_visible])
    rbm.c.copy_(bias[..., model.n_visible :])
    return InBits(rbm, form.offset)
