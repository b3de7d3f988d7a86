"""All states of a small model, one by one: what faster sums are compared with.

States are those of the units and energies those of ``model.energy``, so that kinds of one's own are served, too.
Where the energy itself is in question, :mod:`~memcomp_lightning.testing.brute_force` has it from the parameters.
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from memcomp_lightning.models import EnergyModel
from memcomp_lightning.models.units import Mixed, Units, all_states


class Enumerated(NamedTuple):
    """Every state of the discrete units, with real ones at their means given it.

    Attributes:
        x: Visible and hidden units, ``(n_states, n_units)``.
        variance: Of each unit given the others, ``(n_units,)``; zero unless it is real.
        probability: ``(n_states,)`` float64.
        energy: E at ``x``, ``(n_states,)``.
    """

    x: Tensor
    variance: Tensor
    probability: Tensor
    energy: Tensor

    def moments(self) -> Tensor:
        """Means of all units and of all products of two, ``(n_units + n_units^2,)`` float64."""
        x = self.x.double()
        second = x.mT @ (self.probability.unsqueeze(-1) * x) + torch.diag(self.variance.double())
        return torch.cat((self.probability @ x, second.flatten()))


@torch.no_grad()
def enumerated(
    model: EnergyModel,
    v: Float[Tensor, " n_visible"] | None = None,
    observed: Bool[Tensor, " n_visible"] | None = None,
) -> Enumerated:
    r"""Every state of a model without replicas, or every one that agrees with what is observed of v.

    Real units are those with a curvature :math:`\gamma`, not coupled to each other. One of field f, which is E at
    x = 0 less E at x = 1 without the measure, has the mean :math:`f / \gamma`, and the integral over it is a
    constant times :math:`e^{-E}` there.
    """
    n, x = model.n_visible, torch.zeros(1, 0, dtype=model.b.dtype)
    for kind in (*_parts(model.visible), *_parts(model.hidden)):
        own = x.new_zeros(1, kind.n) if kind.real else all_states(kind, x)
        x = torch.cat((x.repeat_interleave(len(own), dim=0), own.repeat(len(x), 1)), dim=-1)
    curvature = torch.zeros(model.n_units, dtype=x.dtype)
    for begin, layer in ((0, model.visible), (n, model.hidden)):
        if layer.curvature is not None:
            curvature[begin : begin + layer.n] = layer.curvature
    known = torch.zeros(model.n_units, dtype=torch.bool)
    if v is not None:
        known[:n] = observed if observed is not None else True
        pinned = torch.cat((v, v.new_zeros(model.n_hidden)))
        agrees = ((x == pinned) | ~known | (curvature != 0)).all(-1)
        x = torch.where(known & (curvature != 0), pinned, x[agrees])
    free = ((curvature != 0) & ~known).nonzero().flatten().tolist()
    for unit in free:
        off, on = x.clone(), x.clone()
        off[:, unit], on[:, unit] = 0.0, 1.0
        field = model.tempered_energy(off[:, :n], off[:, n:]) - model.tempered_energy(on[:, :n], on[:, n:])
        x[:, unit] = field / curvature[unit]
    variance = torch.zeros_like(curvature)
    variance[free] = 1 / curvature[free]
    energy = model.energy(x[:, :n], x[:, n:])
    return Enumerated(x, variance, torch.softmax(-energy.double(), dim=-1), energy)


def _parts(layer: Units) -> list[Units]:
    return layer.kinds if isinstance(layer, Mixed) else [layer]


def sample_moments(x: Float[Tensor, "n n_units"]) -> tuple[Tensor, Tensor]:
    """The same moments of a sample and their standard errors, float64.

    Products that occur a few times only have errors that are not normal: eight occurrences more are allowed for.
    """
    x, n = x.detach().double(), len(x)
    first, second = x.mean(0), x.mT @ x / n
    fourth = x.square().mT @ x.square() / n
    mean = torch.cat((first, second.flatten()))
    variance = torch.cat((x.var(0), (fourth - second.square()).flatten())).clamp(min=0)
    return mean, (variance / n).sqrt() + 8 / n


def most_errors_off(x: Float[Tensor, "n n_units"], exact: Enumerated) -> float:
    """The largest distance of a moment of a sample from the exact one, in standard errors."""
    mean, error = sample_moments(x)
    return float(((mean - exact.moments()).abs() / error).amax())
