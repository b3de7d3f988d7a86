"""Rows as they are given: batches of our own data modules, or tensors of somebody else's data loader."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, TypeAlias

import torch
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.observed import require_known_rows, require_whole_sites
from memcomp_lightning.models.units import Units
from memcomp_lightning.types import UNLABELLED, Batch

Given: TypeAlias = "Batch | Tensor | Sequence[Tensor]"
"""A batch; or values of the visible units; or these and class indices, as data loaders of tensors have them."""


def as_batch(given: Given, units: Units | None = None) -> Batch:
    """One update's rows as a batch.

    Args:
        given: A batch stays as it is; only its mask is looked at. A tensor ``(*replicas, n, n_visible)``, or a
            pair of it and of classes, is one step of the optimiser; NaN is a missing value. Numbers of categories,
            one a site, become entries.
        units: The visible units, for categories and to check the shape; None takes tensors as they are.

    Raises:
        SettingError: It is something else, has columns or values that the model's units do not take, a row without
            any value, or half a site.

    >>> as_batch(torch.zeros(3, 2)).label.tolist()
    [-1, -1, -1]
    """
    if isinstance(given, Batch):
        if given.observed is not None and units is not None:
            require_known_rows(given.observed, "batch")
            require_whole_sites(units, given.observed)
        return given
    parts: Any = [given] if isinstance(given, Tensor) else given
    tensors = (
        isinstance(parts, list | tuple) and len(parts) in (1, 2) and all(isinstance(x, Tensor) for x in parts)
    )
    require(tensors, "batch", type(given).__name__, "a tensor of rows, a pair of rows and labels, or a Batch")
    v = parts[0] if parts[0].is_floating_point() else parts[0].to(torch.get_default_dtype())
    observed = None
    if bool(v.isnan().any()):
        observed = ~v.isnan()
        require_known_rows(observed, "batch")
        v = torch.where(observed, v, 0.0)
    if units is not None:
        if v.shape[-1] == units.n_sites != units.n:
            v = units.encode(v)
            observed = None if observed is None else units.over_sites(observed)
        require(v.shape[-1] == units.n, "columns of a batch", v.shape[-1], f"{units.n}, the visible units")
        if observed is not None:
            require_whole_sites(units, observed)
        units.check(v, observed)
    label = (
        torch.full(v.shape[:-1], UNLABELLED, dtype=torch.long, device=v.device) if len(parts) == 1 else parts[1]
    )
    return Batch(v, label, share=1.0, closes_step=True, observed=observed)


def updates_of(given: Iterable[Given] | Tensor, units: Units | None = None) -> Iterator[Batch]:
    """The batches of a pass; a tensor by itself is one update with all of its rows."""
    for some in [given] if isinstance(given, Tensor) else given:
        yield as_batch(some, units)


def begin_epoch(batches: object, epoch: int) -> None:
    """Let batches take the order of a pass, if they have one."""
    take = getattr(batches, "set_epoch", None)
    if take is not None:
        take(epoch)
