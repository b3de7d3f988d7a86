"""Data of which some values are missing: a mask, once, where they come in."""

import torch
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.observed import require_known_rows

_ROWS = 2**14
"""That are looked at together."""


def split_missing(v: Tensor, observed: Tensor | None, name: str) -> tuple[Tensor, Tensor | None]:
    """Data with 0 in place of what is missing, uncopied where it is so, and the mask; None where all is there.

    Args:
        v: Data, ``(*axes, n, n_sites)``; NaN is missing.
        observed: Where they are known, a mask of their shape; None is everywhere but at NaN.
        name: Of the data, for errors.

    Raises:
        SettingError: The mask has another shape or dtype, or hides a whole row.
    """
    if v.is_floating_point() and bool(v.sum().isnan()):
        known = ~v.isnan()
        observed = known if observed is None else known & observed
    if observed is None:
        return v, None
    name = f"{name}_observed"
    require(observed.dtype == torch.bool, f"{name}.dtype", observed.dtype, "torch.bool")
    require(observed.shape == v.shape, f"{name}.shape", tuple(observed.shape), f"{tuple(v.shape)}, as the data")
    if bool(observed.all()):
        return v, None
    require_known_rows(observed, name)
    parts = zip(v.split(_ROWS, -2), observed.split(_ROWS, -2), strict=True)
    if not any(bool(some.masked_fill(known, 0).any()) for some, known in parts):  # NaN is something
        return v, observed
    return torch.where(observed, v, torch.zeros((), dtype=v.dtype, device=v.device)), observed
