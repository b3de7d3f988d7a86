"""Couplings as a table: what the parameters are, and what they say of pairs of columns."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning.data.written import write_columns
from memcomp_lightning.models import RBM, BoltzmannMachine, contact_scores, couplings
from memcomp_lightning.models.units import Categorical, Mixed, Units
from memcomp_lightning.trained.export.base import Written
from memcomp_lightning.trained.export.plain import entry_names
from memcomp_lightning.trained.run import Run


class _Term(NamedTuple):
    """Rows of the table.

    Attributes:
        term: Which number it is.
        first: A unit or column each.
        second: The other one, empty for biases.
        value: The numbers.
    """

    term: str
    first: list[str]
    second: list[str]
    value: Tensor


def write(run: Run, path: Path, what: str) -> Written:
    """Write a row a number: ``term``, ``first``, ``second``, ``value``.

    ``weight``, ``bias`` and ``precision`` are the parameters, as they stand in the energy. ``coupling`` and
    ``field`` are the (effective) pair energies of the visible units, in spins and in the zero-sum gauge, see
    :func:`memcomp_lightning.models.couplings`; ``contact`` is one number for two columns, where there are
    categories, see :func:`memcomp_lightning.models.contact_scores`, the largest first.
    """
    model: Any = run.model
    names = entry_names(run, model.n_visible)
    terms = [*_parameters(model, names), *_of_visible(run, model, names)]
    first, second = (np.array([x for term in terms for x in getattr(term, side)]) for side in ("first", "second"))
    columns = {
        "term": np.repeat([term.term for term in terms], [len(term.first) for term in terms]),
        "first": first,
        "second": second,
        "value": torch.cat([term.value.detach().double().cpu() for term in terms]).numpy(),
    }
    write_columns(columns, path, overwrite=True)
    counts = ", ".join(f"{len(term.first)} {term.term}" for term in terms if term.first)
    return Written(f"rows: {counts}")


def _parameters(model: RBM | BoltzmannMachine, names: list[str]) -> Iterator[_Term]:
    """Couplings and biases."""
    hidden = [f"h{k + 1}" for k in range(model.n_hidden)]
    units = [*names, *hidden]
    form = model.quadratic_form()
    if form.pairs is None:
        pairs = [(v, h) for h in hidden for v in names]
    else:
        pairs = [(units[i], units[j]) for i, j in form.pairs.tolist()]
    first, second = ([pair[side] for pair in pairs] for side in (0, 1))
    yield _Term("weight", first, second, form.coupling.flatten())
    yield _Term("bias", units, [""] * len(units), form.bias)
    for layer, kind in ((names, model.visible), (hidden, model.hidden)):
        if kind.curvature is not None:
            real = kind.curvature.nonzero().flatten()
            yield _Term("precision", [layer[k] for k in real.tolist()], [""] * len(real), kind.curvature[real])


def _of_visible(run: Run, model: RBM | BoltzmannMachine, names: list[str]) -> Iterator[_Term]:
    """Pair energies of discrete visible units, and scores of their columns."""
    of_pairs = isinstance(model, RBM) and model.hidden.n_sites == model.n_hidden
    if model.visible.real or not (of_pairs or model.n_hidden == 0):
        return
    found, units = couplings(model), model.visible
    site_of = units.site_of()
    first, second = torch.triu_indices(len(names), len(names), 1, device="cpu")
    between = site_of[first] != site_of[second]
    first, second = first[between], second[between]
    value = found.J.cpu()[first, second]
    yield _Term("coupling", [names[i] for i in first.tolist()], [names[i] for i in second.tolist()], value)
    yield _Term("field", names, [""] * len(names), found.h)
    if not _has_categories(units) or units.n_sites < 2:
        return
    sites = run.schema.site_names if run.schema is not None else [f"site{k + 1}" for k in range(units.n_sites)]
    scores = contact_scores(found).cpu()
    first, second = torch.triu_indices(units.n_sites, units.n_sites, 1, device="cpu")
    value, order = scores[first, second].sort(descending=True, stable=True)
    first, second = first[order], second[order]
    yield _Term("contact", [sites[i] for i in first.tolist()], [sites[i] for i in second.tolist()], value)


def _has_categories(units: Units) -> bool:
    return isinstance(units, Categorical) or (isinstance(units, Mixed) and any(map(_has_categories, units.kinds)))
