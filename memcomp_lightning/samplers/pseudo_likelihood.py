"""Pseudo-likelihood: each site is predicted from the others, so that training needs no samples of the model."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.machine import log2_states, require_few_bits
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.sites import DiscreteSites
from memcomp_lightning.objective import shares
from memcomp_lightning.samplers.positive.exact import with_all_hidden
from memcomp_lightning.types import Configurations, NegativePhase, NoState

MOST_NUMBERS = 2**27
"""Values of units in the configurations of an update, where nobody says how many sites are drawn."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PseudoLikelihood:
    r"""A negative phase whose contrast has the gradient of minus the mean log pseudo-likelihood.

    .. math:: -\sum_j \log p(v_j | v_{-j}) = \sum_j \left(F(v) + \log \sum_a e^{-F(v \text{ with } v_j = a)}\right)

    (Besag 1975; for Potts models Ekeberg et al. 2013.) It is summed over the sites. The value of the contrast is
    no difference of two distributions; its gradient is exact, with *signed* weights:

    - Without hidden units E is quadratic, with no couplings inside a site. With m the mean of each site given all
      others at x, :math:`\sum_j [E(x) - E(x \text{ with } x_j = m_j)] = 3 E(x) + E(m) - 4 E((x + m) / 2)`. The
      negative phase is three configurations a row, of the weights 4, -2 and -1, whatever the number of sites.
    - With hidden units each site takes each of its states a, with the weight :math:`p(a | v_{-j})`, less 1 where
      the data have it; the hidden units follow as in :math:`p(h | v)`. The row itself, with the weight 1, cancels
      against the positive phase. That makes ``n_sites`` times the number of states configurations a row.

    Values in between, which are means, count as the cross-entropy of each site. A row with missing values counts
    as the positive phase completes it. ``info`` has the mean ``log_pseudo_likelihood`` of the rows, before the
    update; where sites are drawn it is an estimate.

    Attributes:
        n_sites: Sites a row that are drawn anew at each call, >= 1, of models with hidden units; the gradient is
            then right in expectation. None takes all, or as many as fit in about 512 MiB of configurations.
        max_units: Hidden units whose states are all summed at most, 1 to 16, where hidden units are coupled to
            each other: 2^max_units configurations for each one.
    """

    uses_data: ClassVar[bool] = True
    shared: ClassVar[bool] = False
    signed_weights: ClassVar[bool] = True

    n_sites: int | None = None
    max_units: int = 8

    def __post_init__(self) -> None:
        if self.n_sites is not None:
            require_count("n_sites", self.n_sites)
        require_count("max_units", self.max_units)
        require(self.max_units <= 16, "max_units", self.max_units, "an integer from 1 to 16")

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> NoState:
        """Check the model.

        Raises:
            SettingError: The visible units are real; more than ``max_units`` hidden units would be summed.
        """
        kind, allowed = type(model.visible).__name__, "discrete units for the pseudo-likelihood"
        remedy = "Use another sampler for real units, say cd or pcd."
        require(not model.visible.real, "kind of the visible units", kind, allowed, remedy)
        if _coupled_hidden_units(model):
            n, allowed = log2_states(model.hidden), f"at most max_units = {self.max_units} where they are coupled"
            remedy = "Use another sampler, say pcd."
            require_few_bits("number of hidden units", n, self.max_units, allowed, remedy)
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return the configurations, whose weights add up to one, those of a row to the row's share."""
        if model.n_hidden == 0:
            found, value = _of_visible_alone(model, positive)
        else:
            found, value = self._of_states(model, positive, generator)
        return NegativePhase(found, state, {"log_pseudo_likelihood": value})

    def _of_states(
        self, model: EnergyModel, positive: Configurations, generator: Generator
    ) -> tuple[Configurations, Tensor]:
        v, share = positive.v, shares(positive)
        sites = DiscreteSites.of(model.visible, like=v)
        n_all = len(sites.entries)
        numbers_a_site = v[..., 0].numel() * sites.exists.shape[-1] * model.n_units
        n_drawn = min(self.n_sites or max(1, MOST_NUMBERS // numbers_a_site), n_all)
        at = torch.arange(n_all, device=v.device).expand(*v.shape[:-1], n_all)
        if n_drawn < n_all:
            at = rng.uniform(at.shape, generator=generator, like=v).topk(n_drawn, dim=-1).indices
        moved, own = _each_state(v, sites, at)
        log_weight, parts = _marginal(model, moved.flatten(-4, -2))
        exists = sites.exists[at]
        log_p = log_weight.double().unflatten(-1, exists.shape[-3:]).masked_fill(~exists, -torch.inf)
        log_p = torch.log_softmax(log_p, dim=-1)
        scale = share.double() * (n_all / n_drawn)
        value = (scale.unsqueeze(-1) * (own * log_p.masked_fill(~exists, 0.0)).sum(-1)).sum((-1, -2))
        weight = (scale[..., None, None] * (log_p.exp() - own)).to(v.dtype).flatten(-3).unsqueeze(-1)
        all_v = [positive.v, *(part.v for part in parts)]
        all_h = [positive.h, *(part.h for part in parts)]
        weights = [share]
        for part in parts:
            assert part.weight is not None
            weights.append((part.weight.unflatten(-1, (weight.shape[-2], -1)) * weight).flatten(-2))
        found = Configurations(torch.cat(all_v, dim=-2), torch.cat(all_h, dim=-2), torch.cat(weights, dim=-1))
        return found, value.to(v.dtype)


def _of_visible_alone(model: EnergyModel, positive: Configurations) -> tuple[Configurations, Tensor]:
    """The three configurations of each row, and the mean log pseudo-likelihood."""
    x, share = positive.v, shares(positive)
    mean, log_p = torch.empty_like(x), torch.zeros_like(share)
    for block in model.blocks():
        field, own = block.field(x), x[..., block.units]
        mean[..., block.units] = block.kind.mean(field)
        log_p = log_p + (field * own).sum(-1) - block.kind.cumulant(field).sum(-1)
    v = torch.cat(((x + mean) / 2, x, mean), dim=-2)
    weight = torch.cat((4 * share, -2 * share, -share), dim=-1)
    return Configurations(v, v[..., :0], weight), (share * log_p).sum(-1)


def _each_state(v: Tensor, sites: DiscreteSites, at: Tensor) -> tuple[Tensor, Tensor]:
    """Rows with a site in each of its states, and the probabilities of these states that the data have.

    The rows are ``(..., n, n_drawn, n_states, n_visible)``, the probabilities ``(..., n, n_drawn, n_states)``: 1
    or 0 but for means.

    Args:
        v: Rows, ``(..., n, n_visible)``.
        sites: Of all sites.
        at: Which ones are changed, ``(..., n, n_drawn)``.
    """
    low, width, bits, exists = (part[at] for part in (sites.low, sites.width, sites.high, sites.exists))
    entries = torch.where(width == 0, v.shape[-1], sites.entries[at])
    wide = torch.cat((v, torch.zeros_like(v[..., :1])), dim=-1)  # one more column takes what is padded
    moved = wide[..., None, None, :].repeat(*[1] * (v.ndim - 1), at.shape[-1], exists.shape[-1], 1)
    values = low.unsqueeze(-2) + width.unsqueeze(-2) * bits
    moved.scatter_(-1, entries.unsqueeze(-2).expand(values.shape), values)
    seen = torch.take_along_dim(wide.unsqueeze(-2), entries, dim=-1)
    on = torch.where(width != 0, (seen - low) / width, 0.0).unsqueeze(-2)
    # A bit by itself has a state without anything high: it has what the other one leaves.
    of_states = torch.where((bits == 0).all(-1), 1 - on.sum(-1), (bits * on).sum(-1))
    return moved[..., : v.shape[-1]], (of_states * exists).double()


def _coupled_hidden_units(model: EnergyModel) -> bool:
    """Whether hidden units are coupled to each other, so that p(h | v) is no product."""
    pairs = model.quadratic_form().pairs
    return pairs is not None and bool((pairs >= model.n_visible).all(-1).any())


def _marginal(model: EnergyModel, v: Tensor) -> tuple[Tensor, list[Configurations]]:
    """Log of the unnormalised probability of visible states, and configurations that stand for p(h | v) of each.

    Configurations of one state are side by side, and have weights that add up to one over all parts.
    """
    if isinstance(model, RBM):
        field = model.hidden_field(v)
        log_weight = model.hidden.cumulant(field).sum(-1) + (v * model.b.unsqueeze(-2)).sum(-1)
        points = model.hidden.points(field)
        weight = torch.full_like(log_weight, 1 / len(points))
        return log_weight, [Configurations(v, h, weight) for h in points]
    if not _coupled_hidden_units(model):
        return -model.free_energy(v), [Configurations(v, model.hidden_mean(v), torch.ones_like(v[..., 0]))]
    found, log_weight = with_all_hidden(model, v)
    return log_weight, [found]
