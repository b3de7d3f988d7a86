"""Independent units given another layer: one direction of a network, with weights of its own."""

import copy

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from memcomp_lightning.models.affine import affine
from memcomp_lightning.models.base import PerState
from memcomp_lightning.models.units import Units


class Conditional(nn.Module):
    r"""The units of one layer, independent given those of another.

    .. math:: p(x | y) = \mu(x) \exp(f \cdot x - \sum A(f)), \qquad f = W y + a

    with the measure and the cumulant A of the units x. Their own parameters stay as they are.

    Args:
        units: Kind of the units x, with the replica axes; copied.
        weight: ``(*replicas, n_x, n_y)``, copied.
        bias: ``(*replicas, n_x)``, copied.
    """

    @torch.inference_mode(False)
    def __init__(self, units: Units, weight: Tensor, bias: Tensor) -> None:
        super().__init__()
        self.units = copy.deepcopy(units).requires_grad_(False)
        self.weight = nn.Parameter(weight.detach().clone(memory_format=torch.contiguous_format))
        self.bias = nn.Parameter(bias.detach().clone())

    def field(self, y: Float[Tensor, "*replicas n n_y"]) -> Float[Tensor, "*replicas n n_x"]:
        """W y + a."""
        return affine(y, self.weight, self.bias)

    def mean(self, y: Tensor) -> Tensor:
        """E[x | y]."""
        return self.units.mean(self.field(y))

    def draw(self, y: Tensor, *, generator: Generator) -> Tensor:
        """Draw x given y."""
        return self.units.sample(self.field(y), generator=generator)

    def log_prob(self, x: Tensor, y: Tensor) -> PerState:
        """Log p(x | y), ``(*replicas, n)``; at means of x, of units with a constant measure, the expected one."""
        return self._log_prob(x, self.field(y))

    def _log_prob(self, x: Tensor, field: Tensor) -> Tensor:
        found = (field * x).sum(-1) - self.units.cumulant(field).sum(-1)
        return found if self.units.linear else found - self.units.energy(x)

    @torch.no_grad()
    def add_gradient(self, x: Tensor, y: Tensor, weight: PerState) -> Float[Tensor, "*replicas"]:
        """Add to the parameters' gradients those of the sum of ``-weight * log p(x | y)``; return the sum.

        The gradient is the delta rule, ``weight * (E[x | y] - x)`` times y, without a graph.
        """
        field = self.field(y)
        excess = (self.units.mean(field) - x) * weight.unsqueeze(-1)
        for parameter, gradient in ((self.weight, excess.mT @ y), (self.bias, excess.sum(-2))):
            parameter.grad = gradient if parameter.grad is None else parameter.grad.add_(gradient)
        return -(weight * self._log_prob(x, field)).sum(-1)
