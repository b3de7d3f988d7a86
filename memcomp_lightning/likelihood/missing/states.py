"""Missing values by a sum over all that they may be: for rows with few of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, cast

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.likelihood.boltzmann import double_of, log_hidden_sum
from memcomp_lightning.likelihood.layers import NUMBERS
from memcomp_lightning.likelihood.missing.base import Conditional, drawn, real_entries
from memcomp_lightning.likelihood.values import MOST_HIDDEN, has_free_energy
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
    r"""Exact sums over values that are missing, discrete ones and few, where hidden units are summed exactly.

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
            SettingError: A real value is missing; hidden units of a machine are coupled, and too many.
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
    wide, v = double_of(model), v.double()
    log_weights = _of_rbm if has_free_energy(model) else _of_whole_rows
    known = torch.where(observed, v, 0.0)
    masks, kinds = torch.unique(observed, dim=0, return_inverse=True)
    for k, mask in enumerate(masks):
        at = (~mask).nonzero().flatten()
        kind = wide.visible.select(at)
        require(not kind.real or not len(at), "units that are missing", "real", "discrete ones")
        states = all_states(kind, v) if len(at) else v.new_zeros(1, 0)
        together = max(1, NUMBERS // (len(states) * wide.n_units))
        for rows in (kinds == k).nonzero().flatten().split(together):
            yield Pattern(rows, at, states, log_weights(wide, known[rows], at, states))


def _of_rbm(model: EnergyModel, known: Tensor, at: Tensor, states: Tensor) -> Tensor:
    """Minus the free energy of each row in each state, ``(n, n_states)``, from one field a row and one a state."""
    rbm = cast(RBM, model)
    of_known = known @ rbm.b if rbm.visible.linear else known @ rbm.b - rbm.visible.energy(known)
    field = rbm.hidden_field(known).unsqueeze(-2) + states @ rbm.weight[:, at].T
    return rbm.hidden.cumulant(field).sum(-1) + states @ rbm.b[at] + of_known.unsqueeze(-1)


def _of_whole_rows(model: EnergyModel, known: Tensor, at: Tensor, states: Tensor) -> Tensor:
    """The same of any machine, whose rows are written out whole."""
    whole = known.unsqueeze(-2).repeat(1, len(states), 1)
    whole[..., at] = states
    of_rows = log_hidden_sum(model, whole.flatten(0, 1), max_units=MOST_HIDDEN)
    found: Tensor = of_rows.unflatten(0, whole.shape[:2])
    return found
