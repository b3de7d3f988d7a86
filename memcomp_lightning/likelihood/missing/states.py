"""Missing values by a sum over all that they may be: for rows with few of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.likelihood.boltzmann import double_of
from memcomp_lightning.likelihood.layers import NUMBERS
from memcomp_lightning.likelihood.missing.base import Conditional, drawn, real_entries
from memcomp_lightning.likelihood.values import has_free_energy
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.units import all_states


class Pattern(NamedTuple):
    """Rows of which the same values are missing.

    Attributes:
        rows: Their numbers, ``(n,)``.
        at: Entries that are missing, ``(n_missing,)``.
        states: What these may be together, ``(n_states, n_missing)``.
        log_weight: Log of the sum over the hidden units of exp(-E), for each row and state, ``(n, n_states)``.
    """

    rows: Tensor
    at: Tensor
    states: Tensor
    log_weight: Tensor


@dataclass(frozen=True, slots=True)
class MissingSums:
    r"""Exact sums over the values that are missing, by the free energies of an RBM: of discrete units, and few.

    .. math:: p(missing | observed) \propto \exp(-F(missing, observed))
    """

    def numbers_a_row(self, model: EnergyModel, m: int) -> int:
        """The row and its draws; the sums are split where they are taken."""
        return (m + 3) * model.n_visible

    @torch.no_grad()
    def find(
        self, model: EnergyModel, v: Tensor, observed: Tensor, *, m: int = 0, generator: Generator
    ) -> Conditional:
        """What is known of the missing values, without any error of sampling.

        Raises:
            SettingError: A real value is missing; the model has no free energy in closed form.
        """
        mean, draws = v.double().clone(), v.double().repeat(m, 1, 1)
        for rows, at, states, log_weight in patterns(model, v, observed):
            weight = torch.softmax(log_weight, dim=-1)
            mean[rows.unsqueeze(-1), at] = weight @ states
            draws[:, rows.unsqueeze(-1), at] = states[drawn(weight, m, generator=generator)]
        none = mean.new_full((3, len(v), len(real_entries(model.visible))), torch.nan)
        return Conditional(mean, none, draws, mean.new_full((len(v),), torch.nan))


@torch.no_grad()
def patterns(model: EnergyModel, v: Tensor, observed: Tensor) -> Iterator[Pattern]:
    """Weights of all that the missing values may be, in float64; rows without gaps have one, empty state."""
    require(
        has_free_energy(model), "model", type(model).__name__, "an RBM, which has a free energy in closed form"
    )
    rbm, v = cast(RBM, double_of(model)), v.double()
    known = torch.where(observed, v, 0.0)
    of_known = known @ rbm.b if rbm.visible.linear else known @ rbm.b - rbm.visible.energy(known)
    masks, kinds = torch.unique(observed, dim=0, return_inverse=True)
    for k, mask in enumerate(masks):
        at = (~mask).nonzero().flatten()
        kind = rbm.visible.select(at)
        require(not kind.real or not len(at), "units that are missing", "real", "discrete ones")
        states = all_states(kind, v) if len(at) else v.new_zeros(1, 0)
        shift, bias = states @ rbm.weight[:, at].T, states @ rbm.b[at]
        together = max(1, NUMBERS // (len(states) * rbm.n_hidden))
        for rows in (kinds == k).nonzero().flatten().split(together):
            field = rbm.hidden_field(known[rows]).unsqueeze(-2) + shift
            log_weight = rbm.hidden.cumulant(field).sum(-1) + bias + of_known[rows].unsqueeze(-1)
            yield Pattern(rows, at, states, log_weight)
