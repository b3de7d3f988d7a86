"""The path of annealed importance sampling for Boltzmann machines of any connectivity."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Generator, Tensor
from tqdm.auto import tqdm

from memcomp_lightning.models.base import EnergyModel, PerReplica, PerState, annealed
from memcomp_lightning.models.one_by_one import in_runs
from memcomp_lightning.models.units import side_by_side


class MachinePath:
    r"""Distributions between independent units and a machine.

    .. math:: p_\beta(x) \propto \mu(x) \exp((1 - \beta) b_0 \cdot v - \beta E(x)), \qquad x = (v, h)

    with the energy E without the measure. The largest class of units, in a semi-restricted machine the hidden
    ones, is summed out of the weights by its cumulants, as the hidden units of an RBM are; each sweep therefore
    draws it first, given all others.

    Args:
        model: The machine, at its present parameters.
        base: Visible bias b_0, ``(*replicas, n_visible)``.
    """

    @torch.no_grad()
    def __init__(self, model: EnergyModel, base: Tensor) -> None:
        self._model, self._units = model, side_by_side(model.visible, model.hidden)
        self._base = torch.cat((base, base.new_zeros(*base.shape[:-1], model.n_hidden)), dim=-1)
        self._summed, _, _ = model.outside_largest_class()
        others = [block for block in model.blocks() if not block.units.equal(self._summed.units)]
        self._runs = in_runs([self._summed, *others])

    def start(self, n: int, *, generator: Generator) -> Tensor:
        """Draw n states a replica at beta = 0, ``(*replicas, n, n_units)``."""
        field = self._base.unsqueeze(-2).expand(*self._base.shape[:-1], n, -1)
        return self._units.sample(field, generator=generator)

    @torch.no_grad()
    def log_z_of_base(self) -> PerReplica:
        """Log Z at beta = 0, in float64."""
        return self._units.cumulant(self._base.double().unsqueeze(-2)).sum((-2, -1))

    @torch.no_grad()
    def anneal(
        self, x: Tensor, betas: Sequence[float], k: int, *, generator: Generator, progress: bool
    ) -> PerState:
        """Log weights of chains that start at x, in equilibrium at the first beta, in float64."""
        log_w = torch.zeros(x.shape[:-1], dtype=torch.float64, device=x.device)
        x = x.clone()
        for beta, target in tqdm(list(pairwise(betas)), desc="annealing", disable=not progress):
            log_w += self._gain(x, beta, target)
            if target != betas[-1]:
                for _ in range(k):
                    for run in self._runs:
                        run.draw(x, target, self._base, generator=generator)
        return log_w

    def _gain(self, x: Tensor, beta: float, target: float) -> Tensor:
        """Log of p_target(y) / p_beta(y) of the units y that are not summed, without their partition functions."""
        summed, n = self._summed, self._model.n_visible
        y = x.index_fill(-1, summed.units, 0.0)
        slope = -self._model.tempered_energy(y[..., :n], y[..., n:]) - (y * self._base.unsqueeze(-2)).sum(-1)
        field, base = summed.field(x).double(), self._base[..., summed.units].double()
        before, after = (summed.kind.cumulant(annealed(field, at, base)).sum(-1) for at in (beta, target))
        return (target - beta) * slope.double() + after - before
