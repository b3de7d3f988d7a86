"""A table as it was, with numbers of a model in its empty cells."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning.data.schema import Columns
from memcomp_lightning.data.tables.cells import TRUTH, Cells
from memcomp_lightning.data.tables.readers import opened
from memcomp_lightning.data.tables.schema import TableSchema
from memcomp_lightning.errors import UserError


def filled(path: Path, schema: TableSchema, v: Tensor) -> Columns:
    """All columns of a file in their order; columns of the model that it does not have follow them.

    Cells that are not empty stay as they are, texts to the letter.

    Args:
        path: The file that v was read from.
        schema: Of the columns that the model has.
        v: Numbers of the sites of all rows, ``(n, n_sites)``.

    Raises:
        UserError: The file has changed since.
    """
    numbers = v.detach().cpu().numpy()
    at = {column.name: site for site, column in enumerate(schema.of_sites)}
    own = {column.name: column for column in schema.columns}
    parts: dict[str, list[NDArray[Any]]] = {}
    n = 0
    for batch in opened(path, key=schema.key).batches:
        here = numbers[n : n + batch.num_rows]
        n += batch.num_rows
        if len(here) != batch.num_rows:
            break
        for name, cells in zip(batch.schema.names, batch.columns, strict=True):
            column = _plain(cells)
            if name in own:
                empty = Cells(cells).empty
                column = _with(column, empty, own[name].write(here[empty, at[name]]))
            parts.setdefault(name, []).append(column)
    if n != len(numbers):
        raise UserError(f"{path} has changed while it was worked on: it had {len(numbers)} rows.")
    columns = {name: np.concatenate(some) for name, some in parts.items()}
    return columns | {name: own[name].write(numbers[:, at[name]]) for name in own if name not in columns}


def others(path: Path, own: Collection[str], *, key: str | None = None) -> Columns:
    """The columns of a file that are none of these, as they are; the others are let go as they are read."""
    parts: dict[str, list[NDArray[Any]]] = {}
    for batch in opened(path, key=key).batches:
        for name, cells in zip(batch.schema.names, batch.columns, strict=True):
            if name not in own:
                parts.setdefault(name, []).append(_plain(cells))
    return {name: np.concatenate(some) for name, some in parts.items()}


def _plain(cells: Any) -> NDArray[Any]:
    """Cells as NumPy has them; of texts objects, None where there is none."""
    if pa.types.is_dictionary(cells.type):
        cells = cells.dictionary_decode()
    if pa.types.is_integer(cells.type) and cells.null_count:  # which would become floats
        return np.array(cells.to_pylist(), dtype=object)
    found: NDArray[Any] = cells.to_numpy(zero_copy_only=False)
    return found


def _with(column: NDArray[Any], empty: NDArray[np.bool_], values: NDArray[Any]) -> NDArray[Any]:
    """A column with other values in its empty cells, as its other cells are."""
    if not empty.any():
        return column
    cells, column = values.tolist(), column.copy()
    known = next(
        (cell for cell in column[~empty].tolist() if cell is not None), "" if column.dtype == object else 0
    )
    if isinstance(known, bool):  # whose words are texts to the model
        cells = [cell == "true" for cell in cells]
    elif isinstance(known, str):
        cells = [_like(known, _text(cell)) for cell in cells]
    column[empty] = cells
    return column


def _like(known: str, text: str) -> str:
    """A truth value in the case of the others."""
    if text not in TRUTH or known.strip().lower() not in TRUTH:
        return text
    return text.upper() if known.isupper() else text.capitalize() if known.strip()[0].isupper() else text


def _text(value: Any) -> str:
    return f"{value:.7g}" if isinstance(value, float) else str(value)
