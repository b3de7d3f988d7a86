"""The affine map of a layer on the replica axis."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.ambient import in_own_dtypes


@in_own_dtypes
def affine(
    x: Float[Tensor, "*replicas n n_in"],
    weight: Float[Tensor, "*replicas n_out n_in"],
    bias: Float[Tensor, "*replicas n_out"],
) -> Float[Tensor, "*replicas n n_out"]:
    """Return ``x W^T + bias``, in one kernel where torch has one: no or one replica axis."""
    if weight.ndim == 2 and x.ndim == 2:
        return F.linear(x, weight, bias)
    if weight.ndim == 3 and x.ndim == 3:
        return torch.baddbmm(bias.unsqueeze(-2), x, weight.mT)
    return x @ weight.mT + bias.unsqueeze(-2)
