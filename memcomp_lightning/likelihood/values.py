"""What likelihoods ask of data and models."""

from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.observed import hidden_units_coupled

MOST_HIDDEN = 16
"""Hidden units of a Boltzmann machine that are enumerated for each image at most."""


def pure_values(model: EnergyModel, v: Tensor, observed: Tensor | None = None) -> Tensor:
    """Data with the model's replica axes, each entry, where observed, a value of its unit.

    Raises:
        SettingError: v has another shape, or a value that the units do not take.
    """
    replicas = model.replicas
    fits = v.ndim >= 2 and v.shape[-1] == model.n_visible and v.shape[:-2] in ((), replicas)
    allowed = f"(n, {model.n_visible}), or with the replica axes {replicas} in front of it"
    require(fits, "shape of v", tuple(v.shape), allowed)
    model.visible.check(v, observed, pure=True)
    return v.expand(*replicas, *v.shape[-2:])


def has_free_energy(model: EnergyModel) -> bool:
    """Whether ``free_energy`` is exact: each hidden unit is coupled to visible ones alone, as in an RBM."""
    return model.quadratic_form().pairs is None


def has_row_sums(model: EnergyModel) -> bool:
    """Whether the sum over the hidden units of a whole row is exact: none of them are coupled, or they are few."""
    return has_free_energy(model) or not hidden_units_coupled(model) or model.n_hidden <= MOST_HIDDEN
