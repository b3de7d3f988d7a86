"""Products of matrices on the replica axis: the affine map of a layer, and sums over configurations."""

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


def plus_product(
    total: Float[Tensor, "*replicas n m"] | None,
    x: Float[Tensor, "*replicas n k"],
    y: Float[Tensor, "*replicas k m"],
) -> Float[Tensor, "*replicas n m"]:
    """Add ``x y`` to a total, in its place and in one kernel where torch has one; None begins one."""
    if total is None:
        return x @ y
    if total.ndim == 2:
        return total.addmm_(x, y)
    return total.baddbmm_(x, y) if total.ndim == 3 else total.add_(x @ y)


def scaled(field: Tensor, beta: float | Tensor) -> Tensor:
    """Field times beta, without a pass over memory in the usual case."""
    return field if isinstance(beta, float) and beta == 1.0 else beta * field
