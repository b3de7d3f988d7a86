"""Data of which some values are missing: what is known of the hidden units then."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel, Hidden, Visible
from memcomp_lightning.models.units import Units

Observed = Bool[Tensor, "*replicas n n_visible"]
"""Where visible units are known; the entries of a categorical site are all known, or none of them."""


def check_observed(model: EnergyModel, v: Tensor, observed: Tensor) -> None:
    """Raise a SettingError for a mask of another shape, or one that hides a row, a column or half a site."""
    check_mask(model, v, observed)
    for axis, name in ((-1, "row"), (-2, "column")):
        hidden = (~observed.any(axis)).nonzero()
        place = hidden[0].tolist()[-1] if len(hidden) else 0
        place = int(model.visible.site_of()[place]) if name == "column" else place
        remedy = f"Leave out the {name}."
        require(not len(hidden), f"observed values in {name} {place}", 0, "one or more", remedy)


def check_mask(model: EnergyModel, v: Tensor, observed: Tensor) -> None:
    """Raise a SettingError for a mask of another shape, or one that hides half a site."""
    require(observed.shape == v.shape, "shape of observed", tuple(observed.shape), f"{tuple(v.shape)}, that of v")
    require(observed.dtype == torch.bool, "dtype of observed", str(observed.dtype), "torch.bool")
    require_whole_sites(model.visible, observed)


def require_whole_sites(units: Units, observed: Tensor) -> None:
    """Raise a SettingError for a mask ``(*axes, n)`` that hides half a site."""
    known = units.site_sums(observed.float())
    sizes = units.site_sums(torch.ones(units.n, device=observed.device))
    half = ((known != 0) & (known != sizes)).nonzero()
    row, site = half[0].tolist()[-2:] if len(half) else (0, 0)
    place = f"observed entries of site {site} in row {row}"
    require(not len(half), place, "a part", "all entries of a site, or none")


def require_known_rows(observed: Tensor, name: str) -> None:
    """Raise a SettingError for a mask ``(*axes, n, n_sites)`` that hides a whole row."""
    hidden = (~observed.any(-1)).nonzero()
    row = hidden[0].tolist()[-1] if len(hidden) else 0
    require(not len(hidden), f"{name}, values known in row {row}", 0, "one or more", "Leave out the row.")


def visible_units_coupled(model: EnergyModel) -> bool:
    """Whether visible units are coupled to each other: then they are not independent given the hidden ones."""
    pairs = model.quadratic_form().pairs
    return pairs is not None and bool((pairs < model.n_visible).all(-1).any())


def hidden_units_coupled(model: EnergyModel) -> bool:
    """Whether hidden units are coupled to each other: if none are, they are summed in closed form."""
    pairs = model.quadratic_form().pairs
    return pairs is not None and bool((pairs >= model.n_visible).all(-1).any())


def visible_field(model: EnergyModel, h: Hidden) -> Visible:
    """Fields of the visible units given the hidden ones.

    Raises:
        SettingError: Visible units are coupled to each other.
    """
    n, coupled = model.n_visible, visible_units_coupled(model)
    remedy = "Draw them instead: positive=clamped_gibbs in training, likelihood.missing of a trained model."
    require(not coupled, "couplings between visible units", True, "none where missing values are summed", remedy)
    x = torch.cat((h.new_zeros(*h.shape[:-1], n), h), dim=-1)
    field = torch.empty_like(x)
    for block in model.blocks():
        field[..., block.units] = block.field(x)
    return field[..., :n]


def log_weight_of_hidden(
    model: EnergyModel, v: Visible, observed: Observed, h: Float[Tensor, "*replicas n_states n_hidden"]
) -> Float[Tensor, "*replicas n n_states"]:
    r"""Log of the sum over the missing values of ``exp(-E(v, h))``, for each row of data and each hidden state.

    .. math:: \log w(h) = -E(0, h) + \sum_{observed} (f_j(h) v_j + \log \mu(v_j)) + \sum_{missing} A(f_j(h))

    with the fields f of the visible units, none of which may be coupled to another.
    """
    units, field = model.visible, visible_field(model, h)
    known = torch.where(observed, v, 0.0)
    missing = (units.site_sums(observed.to(v.dtype)) == 0).to(v.dtype)
    of_hidden = -model.energy(h.new_zeros(*h.shape[:-1], model.n_visible), h)
    found = of_hidden.unsqueeze(-2) + known @ field.mT + missing @ units.cumulant(field).mT
    return found if units.linear else found - units.energy(known).unsqueeze(-1)
