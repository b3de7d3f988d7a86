"""Missing values by a sum over all states of the hidden units."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from memcomp_lightning.likelihood.boltzmann import double_of
from memcomp_lightning.likelihood.missing.base import SHARES, Conditional, drawn, real_entries, width_of
from memcomp_lightning.likelihood.missing.quantiles import mixture_quantile
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.observed import log_weight_of_hidden, visible_field
from memcomp_lightning.models.units import all_states


@dataclass(frozen=True, slots=True)
class HiddenSums:
    r"""Exact sums over the hidden states, for visible units that are not coupled to each other.

    .. math:: p(v_j | observed) = \sum_h p(h | observed) p(v_j | h)

    A real value has a mixture of normal distributions of one width, whose quantiles are the ends of its interval.
    """

    def numbers_a_row(self, model: EnergyModel, m: int) -> int:
        """Weights of the states, and the draws."""
        return 4 * model.hidden.n_states + (m + 2) * model.n_visible

    @torch.no_grad()
    def find(
        self, model: EnergyModel, v: Tensor, observed: Tensor, *, m: int = 0, generator: Generator
    ) -> Conditional:
        """What is known of the missing values, without any error of sampling.

        Raises:
            SettingError: Hidden units are real; visible ones are coupled to each other.
        """
        wide, v = double_of(model), v.double()
        units, states = wide.visible, all_states(wide.hidden, v)
        field = visible_field(wide, states)
        weight = torch.softmax(log_weight_of_hidden(wide, v, observed, states), dim=-1)
        means, real = units.mean(field), real_entries(units)
        mean = weight @ means
        ends = v.new_full((3, len(v), len(real)), torch.nan)
        for column, entry in enumerate(real.tolist()):
            width, component = width_of(units, entry), means[:, entry]
            spread = (
                weight @ (component - component.mean()).square() - (weight @ component - component.mean()) ** 2
            )
            ends[0, :, column] = (width**2 + spread.clamp(min=0)).sqrt()
            missing = (~observed[:, entry]).nonzero().flatten()
            for end, share in zip(ends[1:], SHARES, strict=True):
                if len(missing):
                    end[missing, column] = mixture_quantile(weight[missing], component[None], width, share)
        of_draws = field[drawn(weight, m, generator=generator)]
        draws = torch.where(observed, v, units.sample(of_draws, generator=generator))
        return Conditional(mean, ends, draws, v.new_full((len(v),), torch.nan))
