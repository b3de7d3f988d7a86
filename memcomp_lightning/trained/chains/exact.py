"""Independent rows of models that are small enough to be enumerated."""

import torch
from torch import Generator, Tensor

from memcomp_lightning.likelihood import exact_samples
from memcomp_lightning.likelihood.missing.base import drawn
from memcomp_lightning.likelihood.missing.choice import MOST_HIDDEN_BITS
from memcomp_lightning.models import RBM
from memcomp_lightning.models.machine import log2_states
from memcomp_lightning.models.observed import log_weight_of_hidden, visible_field, visible_units_coupled
from memcomp_lightning.models.units import all_states
from memcomp_lightning.trained.chains.target import Target

MOST_BITS = 16
"""Bits that are enumerated once for all rows."""

NUMBERS = 2**24
"""Numbers of a table that are held at once."""


def why_exact(target: Target) -> str | None:
    """Why rows can be drawn exactly, and what it costs; None if they cannot, or at a price."""
    model = target.model
    if target.v is None:
        n, most, what = model.n_enumerated, MOST_BITS, "of the smaller layer"
        if not isinstance(model, RBM):
            what = "outside the largest class of units"
    elif model.hidden.real or not model.n_hidden or visible_units_coupled(model):
        return None
    else:
        n, most, what = log2_states(model.hidden), MOST_HIDDEN_BITS, "of the hidden layer, for each row"
    return f"all 2^{n:.4g} states {what} are enumerated" if n <= most else None


def exact(target: Target, n: int, *, generator: Generator) -> Tensor:
    """Draw n independent states of the visible units for each row, ``(n_rows * n, n_visible)``, row by row."""
    model = target.model
    if target.v is not None:
        n_numbers = model.hidden.n_states + n * model.n_visible
        parts = target.parts(max(1, NUMBERS // n_numbers))
        return torch.cat([_given(part, n, generator) for part in parts])
    if isinstance(model, RBM):
        return exact_samples(model, n, generator=generator, max_units=MOST_BITS + 1)
    found = model.all_configurations()
    assert found.weight is not None
    number = drawn(found.weight.double().unsqueeze(0), n, generator=generator).squeeze(1)
    x = torch.cat((found.v, found.h), dim=-1)[number]
    largest, _, _ = model.outside_largest_class()
    x[:, largest.units] = largest.kind.sample(largest.field(x), generator=generator)
    return x[:, : model.n_visible]


def _given(target: Target, n: int, generator: Generator) -> Tensor:
    model, v, observed = target.model, target.v, target.observed
    assert v is not None
    assert observed is not None
    states = all_states(model.hidden, v)
    weight = torch.softmax(log_weight_of_hidden(model, v, observed, states).double(), dim=-1)
    number = drawn(weight, n, generator=generator).T.flatten()
    free = model.visible.sample(visible_field(model, states[number]), generator=generator)
    known, fixed = v.repeat_interleave(n, dim=0), observed.repeat_interleave(n, dim=0)
    return torch.where(fixed, known, free)
