"""What is known of a row, in the user's own words."""

from collections.abc import Mapping
from typing import Any

import torch

from memcomp_lightning.data.rows import UNLABELLED, Rows
from memcomp_lightning.data.schema import Schema
from memcomp_lightning.errors import UserError

FAR = 8.0
"""Standard deviations from the mean of the training data."""

_SPELT = {True: ("true", "yes", "on", "y"), False: ("false", "no", "off", "n")}
"""Words that YAML takes for truth values."""


def given_row(schema: Schema, given: Mapping[str, Any]) -> Rows:
    """One row of which some columns are known.

    Args:
        schema: Of the run.
        given: Values by column, as the user writes them: ``{"age": 30, "sex": "f"}``.

    Raises:
        UserError: There is no such column, or it cannot have this value.
    """
    names = schema.site_names
    if not given:
        raise UserError(f"given = {{}} has no column: expected known values, as in {{{names[0]}: VALUE}}.")
    for name in given:
        if name not in names:
            shown = ", ".join(names[:10]) + (", ..." if len(names) > 10 else "")
            raise UserError(f"given has a column {name!r}, which the model has not: it has {shown}.")
    encode = getattr(schema, "encode", None)
    if encode is not None:
        return _of_table(schema, given)
    numbers = [_number(schema, name, given[name]) if name in given else float("nan") for name in names]
    return _rows(torch.tensor([numbers], dtype=torch.float32, device="cpu"))


def unlike_training(schema: Schema, rows: Rows) -> list[str]:
    """A sentence for each known real value that is far from all that a model has been trained on.

    The model answers all the same, by what it has learned elsewhere.
    """
    found = []
    for site, column in enumerate(getattr(schema, "of_sites", ())):
        if column.kind != "real":
            continue
        v = rows.v[:, site] if rows.observed is None else rows.v[rows.observed[:, site], site]
        furthest = float(v.abs().max()) if len(v) else 0.0
        if furthest > FAR:
            found.append(
                f"given, column {column.name!r}: a value is {furthest:.0f} standard deviations from the "
                f"mean of the training data, {column.mean:.4g}; the model has seen nothing like it"
            )
    return found


def _of_table(schema: Any, given: Mapping[str, Any]) -> Rows:
    import pyarrow as pa

    words = {column.name: getattr(column, "words", ()) for column in schema.columns}
    cells = {name: [_as_spelt(value, words[name])] for name, value in given.items()}
    found = schema.encode(pa.table(cells).to_batches()[0], "given", complete=False)
    return _rows(torch.from_numpy(found.v))


def _rows(v: torch.Tensor) -> Rows:
    return Rows(v.nan_to_num(nan=0.0), torch.full((len(v),), UNLABELLED, device="cpu"), ~v.isnan())


def _as_spelt(value: Any, words: tuple[Any, ...]) -> Any:
    """The word of a column that YAML took for a truth value; any other value as it is."""
    if not isinstance(value, bool):
        return value
    return next((word for word in words if str(word).lower() in _SPELT[value]), str(value).lower())


def _number(schema: Schema, name: str, value: Any) -> float:
    """Number of a site: that of its state, or the value itself, where it has one entry."""
    own = [entry.partition("=")[2] for entry in schema.entry_names if entry.partition("=")[0] == name]
    if own == [""]:
        if isinstance(value, int | float) and 0 <= value <= 1:
            return float(value)
        raise UserError(f"given, column {name!r}: {value!r} is not allowed: expected a number in [0, 1].")
    if str(value) in own:
        return float(own.index(str(value)))
    raise UserError(f"given, column {name!r}: {value!r} is not allowed: expected one of {', '.join(own)}.")
