"""Writes columns to a file, by its ending."""

import gzip
import io
import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from memcomp_lightning.data.schema import Columns, ImageSchema, Schema
from memcomp_lightning.errors import UserError
from memcomp_lightning.files import as_csv, written_whole

ENDINGS = (".csv", ".csv.gz", ".tsv", ".parquet", ".npz", ".fasta")
"""Of the files that are written."""

TABLES = tuple(ending for ending in ENDINGS if ending != ".fasta")
"""Of those that hold columns of any kind."""

SEQUENCE = "sequence"
"""The column that FASTA files are made of; another one, ``name``, gives the headers."""

_NO_ARROW = "Parquet needs Arrow, which is not installed: pip install pyarrow."


def check_output(
    path: Path, *, overwrite: bool, endings: Sequence[str] = ENDINGS, setting: str = "output"
) -> None:
    """Refuse, before anything is computed, a file that cannot be written or is there already.

    Args:
        path: The file.
        overwrite: Whether it may be there.
        endings: That it may have.
        setting: The name of the setting, for the error.

    Raises:
        UserError: It says what to type.
    """
    if not path.name.lower().endswith(tuple(endings)):
        raise UserError(f"{setting}={path}: expected a file that ends in {', '.join(endings)}.")
    if path.is_dir() or not path.parent.is_dir():
        raise UserError(f"{setting}={path}: {'this is a folder' if path.is_dir() else 'there is no such folder'}.")
    if path.exists() and not overwrite:
        raise UserError(f"{setting}={path}: the file is there already. Choose another, or type overwrite=true.")
    if not os.access(path.parent, os.W_OK):
        raise UserError(f"{setting}={path}: you may not write in its folder. Choose another.")
    if path.suffix.lower() == ".parquet" and find_spec("pyarrow") is None:
        raise UserError(f"{setting}={path}: {_NO_ARROW}")


def check_kind(path: Path, schema: Schema) -> None:
    """Refuse, before anything is computed, a file of sequences for other rows.

    Raises:
        UserError: It says which endings there are.
    """
    if path.name.lower().endswith(".fasta") and SEQUENCE not in schema.decode(torch.zeros(1, schema.n_sites)):
        raise UserError(f"output={path}: these rows are no sequences. Choose .csv, .parquet or .npz.")


def in_one_array(columns: Columns, schema: Schema, path: Path) -> Columns:
    """Columns of an ``.npz`` of arrays or pictures as one array, as it is read again; all others as they are."""
    numbered = not getattr(schema, "named", True) and list(columns) == [str(k) for k in range(len(columns))]
    if not path.name.lower().endswith(".npz") or not (numbered or isinstance(schema, ImageSchema)):
        return columns
    rows = np.stack(list(columns.values()), axis=1)
    if isinstance(schema, ImageSchema) and schema.layout.pixels is None:
        rows = rows.reshape(-1, schema.layout.height, schema.layout.width)
    return {getattr(schema, "key", None) or "x": rows}


def write_columns(columns: Columns, path: Path, *, overwrite: bool = False) -> None:
    """Write a table whole or not at all: CSV, TSV, Parquet, npz (an array a column), or FASTA.

    Raises:
        UserError: The file is there already and ``overwrite`` is false; it has no column of sequences for FASTA.
    """
    check_output(path, overwrite=overwrite)
    name = path.name.lower()
    with written_whole(path) as partial:
        if name.endswith(".npz"):
            with partial.open("wb") as file:
                np.savez_compressed(file, **{key: _plain(column) for key, column in columns.items()})  # type: ignore[arg-type]
        elif name.endswith(".parquet"):
            _parquet(columns, partial)
        elif name.endswith(".fasta"):
            partial.write_text(_fasta(columns, path), encoding="utf-8")
        else:
            text = _text(columns, "\t" if name.endswith(".tsv") else ",")
            packed = gzip.compress(text.encode(), mtime=0) if name.endswith(".gz") else text.encode()
            partial.write_bytes(packed)


def _text(columns: Columns, delimiter: str) -> str:
    cells = [_cells(column) for column in columns.values()]
    if delimiter == ",":
        return as_csv([list(columns), *zip(*cells, strict=True)])
    import csv

    buffer = io.StringIO()
    csv.writer(buffer, delimiter=delimiter, lineterminator="\n").writerows(
        [list(columns), *zip(*cells, strict=True)]
    )
    return buffer.getvalue()


def _cells(column: NDArray[Any]) -> list[Any]:
    """Cells as texts have them: numbers with all digits of their precision, empty where there are none."""
    if column.dtype.kind in "mM":
        return ["" if text == "NaT" else text for text in column.astype(str).tolist()]
    digits = 7 if column.dtype.itemsize == 4 else 17
    return [_cell(x, digits) for x in column.tolist()]


def _cell(x: Any, digits: int) -> Any:
    if isinstance(x, float):
        whole = x.is_integer() and abs(x) < 1e15
        return "" if x != x else f"{x:.0f}" if whole else repr(x) if digits > 7 else f"{x:.{digits}g}"
    return "" if x is None else x


def _plain(column: NDArray[Any]) -> NDArray[Any]:
    """Texts as texts: objects would be pickled."""
    if column.dtype != object:
        return column
    return np.array(["" if x is None else str(x) for x in column.tolist()])


def _parquet(columns: Columns, path: Path) -> None:
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError as error:
        raise UserError(_NO_ARROW) from error
    parquet.write_table(pa.table({name: pa.array(x, from_pandas=True) for name, x in columns.items()}), path)


def _fasta(columns: Columns, path: Path) -> str:
    if SEQUENCE not in columns:
        raise UserError(f"output={path}: these rows are no sequences. Choose .csv, .parquet or .npz.")
    sequences = columns[SEQUENCE].tolist()
    names = columns["name"].tolist() if "name" in columns else [str(k + 1) for k in range(len(sequences))]
    return "".join(f">{name}\n{sequence}\n" for name, sequence in zip(names, sequences, strict=True))
