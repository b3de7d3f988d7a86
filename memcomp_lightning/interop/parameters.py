"""What all RBMs of other libraries share: parameters as arrays, and what our own are in bits."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning.errors import UserError, require
from memcomp_lightning.models import RBM
from memcomp_lightning.models.units import Bernoulli, Categorical, Mixed, Spin, Units


def tensor_of(values: Any, name: str) -> Tensor:
    """An array or tensor as a new tensor on the CPU: float32 stays, everything else becomes float64.

    Raises:
        UserError: It is no array of finite numbers.
    """
    try:
        array = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values)
        found = torch.from_numpy(array.astype(np.float32 if array.dtype == np.float32 else np.float64))
    except (TypeError, ValueError) as error:
        raise UserError(f"{name} is a {type(values).__name__}: expected an array of numbers.") from error
    if not bool(found.isfinite().all()):
        raise UserError(f"{name} has an entry that is NaN or infinite: it is of training that diverged.")
    return found


@torch.no_grad()
def rbm_of(weight: Tensor, b: Tensor, c: Tensor, visible: Units | None = None) -> RBM:
    """An RBM with these parameters, in the precision of the weights, with hidden units in {0, 1}.

    Args:
        weight: ``(n_hidden, n_visible)``.
        b: Visible bias, ``(n_visible,)``.
        c: Hidden bias, ``(n_hidden,)``.
        visible: Kind of the visible units; None is {0, 1}.

    Raises:
        UserError: The shapes do not go together.
    """
    shapes = tuple(weight.shape), tuple(b.shape), tuple(c.shape)
    if weight.ndim != 2 or shapes[1:] != ((weight.shape[1],), (weight.shape[0],)):
        raise UserError(
            f"weights (hidden, visible), visible and hidden biases do not go together: their shapes are {shapes}."
        )
    rbm = RBM(visible=visible or Bernoulli(weight.shape[1]), n_hidden=weight.shape[0]).to(weight.dtype)
    rbm.weight.copy_(weight)
    rbm.b.copy_(b)
    rbm.c.copy_(c)
    return rbm


@torch.no_grad()
def in_bits(rbm: RBM, library: str) -> RBM:
    """The RBM with the same energies up to a constant whose spins are bits, -1 read as 0; categories stay.

    Args:
        rbm: Without replica axes.
        library: What needs it, for errors.

    Raises:
        SettingError: Real units, several kinds of which one is categories, hidden categories; replicas.
    """
    require(isinstance(rbm, RBM), f"model for {library}", type(rbm).__name__, "an RBM")
    remedy = "Take one of them: load(PATH, replica=0)."
    require(rbm.replicas == (), f"replicas of an RBM for {library}", rbm.replicas, "()", remedy)
    two_values, categories = "units in {0, 1} or {-1, 1}", isinstance(rbm.visible, Categorical)
    fits = categories or _of_two_values(rbm.visible)
    require(fits, f"visible units for {library}", type(rbm.visible).__name__, f"{two_values}, or categories alone")
    require(_of_two_values(rbm.hidden), f"hidden units for {library}", type(rbm.hidden).__name__, two_values)
    form = rbm.in_bits().form
    b, c = form.bias.split([rbm.n_visible, rbm.n_hidden], dim=-1)
    return rbm_of(form.coupling, b, c, rbm.visible if categories else None)


def _of_two_values(units: Units) -> bool:
    if isinstance(units, Mixed):
        return all(map(_of_two_values, units.kinds))
    return isinstance(units, Bernoulli | Spin)
