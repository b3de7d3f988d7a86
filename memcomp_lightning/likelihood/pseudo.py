"""Pseudo-likelihoods, which need no log Z: each visible unit given all others."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.likelihood.boltzmann import double_of, log_hidden_sum
from memcomp_lightning.likelihood.layers import NUMBERS, in_chunks
from memcomp_lightning.likelihood.values import MOST_HIDDEN, has_free_energy, pure_values
from memcomp_lightning.models.base import EnergyModel, Images
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.sites import DiscreteSites
from memcomp_lightning.models.units import Units

NODES_A_DEVIATION = 4
"""Nodes of the trapezoidal rule a standard deviation of a real unit, of which its error is far below rounding."""

TAIL = 9.0
"""Standard deviations beyond the outermost means that the rule covers."""

MOST_NODES = 100_000
"""Nodes of a unit at most: more are needed where couplings are huge beside its precision."""

LogWeight = Callable[[Tensor], Tensor]
"""Log of the unnormalised probability of visible states, ``(*replicas, n, n_visible)`` to ``(*replicas, n)``."""


@torch.no_grad()
def log_pseudo_likelihood(model: EnergyModel, v: Images) -> Float[Tensor, "*replicas n n_sites"]:
    r"""Return log p(v_j | all other v) of each site j of each image in float64; needs no log Z.

    .. math:: \log p(v_j | v_{-j}) = -F(v) - \log \sum_x \exp(-F(v \text{ with } v_j = x))

    (Besag 1975.) Of a real unit the sum is an integral, by the trapezoidal rule, and p a density. In an RBM the
    hidden field for another value differs by columns of W; in a Boltzmann machine the hidden units, up to 16
    outside their largest class, are enumerated. The images are those of :func:`log_likelihood`; the log
    pseudo-likelihood of one is the sum over the last axis.

    Raises:
        SettingError: v has values that the units do not take, or the wrong shape; too many hidden units would have
            to be enumerated.
    """
    v, wide = pure_values(model, v), double_of(model)
    if model.n_hidden == 0:
        return in_chunks(lambda rows: _of_visible_alone(wide, rows), v, model.n_units)
    sites = DiscreteSites.of(model.visible, like=v.double())
    real = model.visible.real_entries().nonzero().flatten().tolist()
    site_of = model.visible.site_of().to(v.device)
    n_numbers = max(1, len(sites.at)) * max(model.n_hidden, model.n_visible)

    def of_rows(rows: Tensor) -> Tensor:
        found = rows.new_empty(*rows.shape[:-1], model.visible.n_sites)
        if isinstance(wide, RBM):
            found[..., sites.at] = _discrete_of_rbm(wide, rows, sites)
            log_weight: LogWeight = lambda some: -wide.free_energy(some)  # noqa: E731
        else:
            log_weight = lambda some: log_hidden_sum(wide, some, MOST_HIDDEN)  # noqa: E731
            found[..., sites.at] = _discrete(log_weight, rows, sites)
        for entry in real:
            found[..., site_of[entry]] = _real(log_weight, wide, rows, entry, n_numbers)
        return found

    if not has_free_energy(model):
        n_numbers *= model.n_visible
    return in_chunks(of_rows, v, n_numbers)


def _state_of(rows: Tensor, sites: DiscreteSites) -> Tensor:
    """Number of the state that each site is in, ``(*replicas, n, n_sites)``."""
    off = (rows[..., sites.entries].unsqueeze(-2) - sites.values).abs().sum(-1)
    return off.masked_fill(~sites.exists, torch.inf).argmin(-1)


def _other(state: Tensor, k: int, sites: DiscreteSites) -> tuple[Tensor, Tensor]:
    """The k-th state after each one, and whether there is such a one."""
    other = (state + k) % sites.exists.shape[-1]
    exists = torch.take_along_dim(sites.exists.expand(*other.shape, -1), other.unsqueeze(-1), -1).squeeze(-1)
    return other, exists


def _discrete_of_rbm(rbm: RBM, rows: Tensor, sites: DiscreteSites) -> Tensor:
    """Of discrete sites of an RBM: another state changes the hidden field by columns of W."""
    field, state = rbm.hidden_field(rows), _state_of(rows, sites)
    change = torch.einsum("saw,...isw->...sai", sites.values, rbm.weight[..., sites.entries]).unsqueeze(-4)
    bias = torch.einsum("saw,...sw->...sa", sites.values, rbm.b[..., sites.entries]).unsqueeze(-3)
    now, own = (_at(table, state) for table in (change, bias.unsqueeze(-1)))
    total = rbm.hidden.cumulant(field).sum(-1, keepdim=True)
    gains = [torch.zeros_like(state, dtype=torch.float64)]
    for k in range(1, sites.exists.shape[-1]):
        other, exists = _other(state, k, sites)
        moved = field.unsqueeze(-2) + (_at(change, other) - now)
        gain = rbm.hidden.cumulant(moved).sum(-1) - total + (_at(bias.unsqueeze(-1), other) - own).squeeze(-1)
        gains.append(gain.masked_fill(~exists, -torch.inf))
    return -torch.stack(gains).logsumexp(0)


def _at(table: Tensor, state: Tensor) -> Tensor:
    """Rows of ``(*replicas, 1, n_sites, n_states, m)`` at ``(*replicas, n, n_sites)``: ``(..., n_sites, m)``."""
    return torch.take_along_dim(table, state[..., None, None], dim=-2).squeeze(-2)


def _discrete(log_weight: LogWeight, rows: Tensor, sites: DiscreteSites) -> Tensor:
    """Of discrete sites, by the weight of each other state."""
    state, here = _state_of(rows, sites), log_weight(rows).unsqueeze(-1)
    gains = [torch.zeros_like(state, dtype=torch.float64)]
    numbers, values = torch.arange(len(sites.entries), device=rows.device), sites.values
    for k in range(1, sites.exists.shape[-1]):
        other, exists = _other(state, k, sites)
        moved = rows.unsqueeze(-2).repeat(*[1] * (rows.ndim - 1), len(numbers), 1)
        # Padding repeats the first entry: it is written last.
        for place in reversed(range(sites.entries.shape[-1])):
            column = sites.entries[:, place]
            moved[..., numbers, column] = values[numbers, other, place]
        weights = log_weight(moved.flatten(-3, -2)).unflatten(-1, state.shape[-2:])
        gains.append((weights - here).masked_fill(~exists, -torch.inf))
    return -torch.stack(gains).logsumexp(0)


def _real(log_weight: LogWeight, model: EnergyModel, rows: Tensor, entry: int, numbers_a_row: int) -> Tensor:
    """Of a real unit: its density given the others, its integral by the trapezoidal rule."""
    curvature = model.visible.curvature
    assert curvature is not None
    precision = curvature[..., entry]
    reach, deviation = _reach(model, entry), precision.rsqrt()
    middle = model.b[..., entry] / precision
    low, high = (middle + sign * (reach / precision + TAIL * deviation) for sign in (-1, 1))
    n_nodes = int(((high - low) / deviation * NODES_A_DEVIATION).max().ceil()) + 1
    if n_nodes > MOST_NODES:
        raise ValueError(f"couplings of visible unit {entry} are too large for its precision: training diverged.")
    step = (high - low) / (n_nodes - 1)
    nodes = low.unsqueeze(-1) + step.unsqueeze(-1) * torch.arange(n_nodes, device=rows.device)
    total = rows.new_full(rows.shape[:-1], -torch.inf)
    together = max(1, NUMBERS // (rows[..., 0].numel() * numbers_a_row))
    for some in nodes.split(together, dim=-1):
        moved = rows.unsqueeze(-3).repeat(*[1] * (rows.ndim - 2), some.shape[-1], 1, 1)
        moved[..., entry] = some.unsqueeze(-1)
        log_weights = log_weight(moved.flatten(-3, -2)).unflatten(-1, (some.shape[-1], rows.shape[-2]))
        total = torch.logaddexp(total, log_weights.logsumexp(-2))
    return log_weight(rows) - total - step.log().unsqueeze(-1)


def _reach(model: EnergyModel, entry: int) -> Tensor:
    """How far couplings may move the field of a unit from its bias, ``(*replicas,)``."""
    largest = torch.cat([_largest_values(units) for units in (model.visible, model.hidden)]).to(model.b)
    for block in model.blocks():
        at = (block.units == entry).nonzero().flatten()
        if len(at):
            reach: Tensor = (block.weight[..., at[0], :].abs() * largest[block.neighbours]).sum(-1)
            return reach
    raise AssertionError("every unit is in a class")


def _largest_values(units: Units) -> Tensor:
    """Largest absolute value of each discrete entry, ``(n,)``; zero of real ones, which couple to no real unit."""
    form = units.bits()
    return torch.zeros(units.n, device="cpu").index_copy(
        0, form.at, form.low.abs().maximum((form.low + form.width).abs())
    )


def _of_visible_alone(model: EnergyModel, rows: Tensor) -> Tensor:
    """Without hidden units: each class follows from its fields."""
    found = rows.new_empty(*rows.shape[:-1], model.visible.n_sites)
    site_of = model.visible.site_of().to(rows.device)
    for block in model.blocks():
        field, x = block.field(rows), rows[..., block.units]
        log_weight = block.kind.site_sums(field * x)
        if not block.kind.linear:
            log_weight = log_weight - block.kind.site_energies(x)
        sites = site_of[block.units].unique_consecutive()
        found[..., sites] = log_weight - block.kind.cumulant(field)
    return found
