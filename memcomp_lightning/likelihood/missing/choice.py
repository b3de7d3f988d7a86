"""Which way to take for which rows: sums where they are short, chains and annealing where they are not."""

import math
from typing import NamedTuple, cast

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.likelihood.exact import log_likelihood
from memcomp_lightning.likelihood.missing.annealing import ObservedAis, ObservedEstimate
from memcomp_lightning.likelihood.missing.base import ConditionalFinder
from memcomp_lightning.likelihood.missing.chains import MissingChains
from memcomp_lightning.likelihood.missing.hidden import HiddenSums
from memcomp_lightning.likelihood.missing.states import MissingSums, patterns
from memcomp_lightning.likelihood.values import MOST_HIDDEN, has_free_energy, has_row_sums
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.machine import log2_states
from memcomp_lightning.models.observed import visible_units_coupled
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.sites import sites_of

MOST_HIDDEN_BITS = 12
"""Of the hidden layer, whose states are summed for all rows at once."""

MOST_MISSING_BITS = 10
"""Of what is missing in a row."""


class Group(NamedTuple):
    """Rows, and what finds their missing values.

    Attributes:
        finder: The way.
        rows: Their numbers, ``(n,)``.
    """

    finder: ConditionalFinder
    rows: Tensor


def finders(
    model: EnergyModel, observed: Bool[Tensor, "n n_visible"], chains: MissingChains | None = None
) -> list[Group]:
    """How the missing values of each row are found; rows without any are left out.

    The hidden states are summed where they are at most 2^12, the states of what is missing where these are at most
    2^10 and hidden units have exact sums; the rest is left to chains.

    Args:
        model: Without replica axes.
        observed: Where the visible units are known.
        chains: Settings of the chains.
    """
    gaps = ~observed.all(-1)
    summed = _sums_hidden(model, MOST_HIDDEN_BITS)
    few = (missing_bits(model, observed) <= MOST_MISSING_BITS) & has_row_sums(model)
    ways: list[tuple[ConditionalFinder, Tensor]] = [
        (HiddenSums(), gaps & summed),
        (MissingSums(), gaps & few & (not summed)),
        (chains or MissingChains(), gaps & ~few & (not summed)),
    ]
    return [Group(finder, rows.nonzero().flatten()) for finder, rows in ways if bool(rows.any())]


def of_observed(
    model: EnergyModel,
    v: Float[Tensor, "n n_visible"],
    observed: Bool[Tensor, "n n_visible"],
    *,
    generator: Generator,
    annealing: ObservedAis | None = None,
) -> ObservedEstimate:
    """Log of the sum of exp(-E) over hidden units and missing values: exact where it can be, else annealed.

    Annealing is for RBMs; in another machine rows of which more than 2^10 states are missing get NaN.

    Args:
        model: Without replica axes.
        v: Values of the visible units.
        observed: Where they are known.
        generator: Of the annealing.
        annealing: Its settings.

    Raises:
        SettingError: A machine with many hidden units that are coupled to each other.
    """
    if _sums_hidden(model, MOST_HIDDEN):
        log_weight = log_likelihood(model, v, v.new_zeros((), dtype=torch.float64), observed=observed)
        return ObservedEstimate(log_weight, torch.zeros_like(log_weight))
    allowed = f"none, or at most {MOST_HIDDEN} hidden units, for rows with missing values"
    require(has_row_sums(model), "couplings between hidden units", True, allowed)
    few = missing_bits(model, observed) <= MOST_MISSING_BITS
    log_weight, error = torch.full((2, len(v)), torch.nan, dtype=torch.float64, device=v.device)
    at = few.nonzero().flatten()
    if len(at):
        for pattern in patterns(model, v[at], observed[at]):
            log_weight[at[pattern.rows]] = pattern.log_weight.logsumexp(-1)
        error[at] = 0.0
    at = (~few).nonzero().flatten()
    if len(at) and has_free_energy(model):
        found = (annealing or ObservedAis()).estimate(cast(RBM, model), v[at], observed[at], generator=generator)
        log_weight[at], error[at] = found
    return ObservedEstimate(log_weight, error)


def missing_bits(model: EnergyModel, observed: Bool[Tensor, "n n_visible"]) -> Float[Tensor, " n"]:
    """Log2 of the number of states of what is missing of each row; infinite where a real value is."""
    units = model.visible
    n_states = [math.inf if site.numbers is None else len(site.numbers) for site in sites_of(units)]
    bits = torch.tensor(n_states, dtype=torch.float64, device=observed.device).log2()
    missing = units.site_sums(observed.double()) == 0
    return torch.where(missing, bits, 0.0).sum(-1)


def _sums_hidden(model: EnergyModel, most_bits: int) -> bool:
    few = not model.hidden.real and log2_states(model.hidden) <= most_bits
    return few and not visible_units_coupled(model)
