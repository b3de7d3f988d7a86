"""Reads tables and arrays of any format, some rows at a time."""

import csv
import gzip
import io
import math
import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from memcomp_lightning.array_files import opened_arrays
from memcomp_lightning.data.tables.cells import EMPTY, Cells
from memcomp_lightning.errors import UserError

ROWS = 16_384
"""Rows that are read at a time, where a format lets one choose."""


MOST_COLUMNS = 1_000_000
"""Of an array: each is a unit of a model. More are taken for a misprint in a header."""


class Opened(NamedTuple):
    """A table that is being read.

    Attributes:
        batches: Its rows, as record batches of Arrow.
        named: Whether the columns have names of their own; those of arrays are numbers.
        n: Number of rows, where it is known before they are read.
    """

    batches: Iterator[Any]
    named: bool
    n: int | None = None

    def counted(self) -> int:
        """Number of rows; where it is not known, all are read."""
        return sum(batch.num_rows for batch in self.batches) if self.n is None else self.n


TEXTS = (".csv", ".tsv", ".txt", ".data")
EXCEL = (".xlsx", ".xls", ".ods")
ARRAYS = (".npy", ".npz", ".h5", ".hdf5")
ENDINGS = (*TEXTS, ".parquet", *EXCEL, *ARRAYS)
"""Of the files that are read."""


def ending_of(path: Path) -> str:
    """What tells the kind of a file: its ending, without that of a compressed one."""
    endings = [ending.lower() for ending in path.suffixes]
    return endings[-2] if len(endings) > 1 and endings[-1] in (".gz", ".bz2") else "".join(endings[-1:])


def opened(path: Path, *, key: str | None = None) -> Opened:
    """Begin to read a file, by its ending.

    Args:
        path: CSV or TSV (also .gz, .bz2), Parquet, Excel, ``.npy``, ``.npz`` (of arrays, or sparse), HDF5.
        key: Which array of an ``.npz`` or HDF5 file; None is the only one, or ``x``, or all of an ``.npz`` whose
            arrays are columns, as it is written for tables.

    Raises:
        UserError: The file does not exist, is damaged, ends in the middle, or is of another kind.
    """
    if not path.is_file():
        raise UserError(f"{path}: there is no such file.")
    ending = ending_of(path)
    if ending in ARRAYS:
        return _checked(_array(path, ending, key), path)
    readers = {**dict.fromkeys(TEXTS, _texts), ".parquet": _parquet, **dict.fromkeys(EXCEL, _excel)}
    if ending in readers:
        return _checked(readers[ending](path), path)
    raise UserError(f"{path}: files that end in {ending!r} are not read; known are {', '.join(ENDINGS)}.")


def of_frame(frame: Any) -> Opened:
    """A DataFrame of pandas, or a table of Arrow."""
    try:
        if not isinstance(frame, pa.Table):
            _no_name_twice([str(name) for name in frame.columns])
        table = frame if isinstance(frame, pa.Table) else pa.Table.from_pandas(frame, preserve_index=False)
    except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
        reason = " ".join(str(part) for part in error.args)
        raise UserError(
            f"a column mixes kinds of values: {reason}. Make them all texts or all numbers."
        ) from error
    table = table.rename_columns([str(name) for name in table.column_names])
    _no_name_twice(table.column_names)
    return Opened(iter(table.to_batches(max_chunksize=ROWS)), True, table.num_rows)


def of_array(array: Any, where: str = "") -> Opened:
    """A matrix of NumPy, SciPy, torch or h5py; ``where`` it is begins errors."""
    if hasattr(array, "detach"):
        array = array.detach().cpu().numpy()
    if not hasattr(array, "dtype"):
        array = np.asarray(array)
    if len(array.shape) < 2:
        raise UserError(f"{where}an array of shape {array.shape}: expected rows and columns.")
    if 0 in array.shape[1:]:
        raise UserError(f"{where}an array of shape {array.shape}: expected one column or more.")
    if math.prod(array.shape[1:]) > MOST_COLUMNS:
        allowed = f"expected at most {MOST_COLUMNS:,} columns"
        raise UserError(f"{where}an array of shape {array.shape}: {allowed}.")
    if array.dtype.kind in "cV":
        raise UserError(f"{where}an array of {array.dtype}: expected numbers, truth values or texts.")
    return Opened(_rows_of(array), False, array.shape[0])


def _no_name_twice(names: list[str], where: str = "") -> None:
    if len(set(names)) < len(names):
        twice = min(name for name in names if names.count(name) > 1)
        raise UserError(f"{where}two columns have the name {twice!r}: give each a name of its own.")


def _checked(found: Opened, path: Path) -> Opened:
    """The same with errors that say where the file is damaged."""

    def batches() -> Iterator[Any]:
        with _damage(path):
            yield from found.batches

    return found._replace(batches=batches())


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    try:
        yield
    except (pa.ArrowException, OSError, EOFError, ValueError, LookupError, RuntimeError, zlib.error) as error:
        if isinstance(error, UserError):
            raise
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> UserError:
    reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
    if "pickle" in reason or "Python objects" in reason:
        reason = "it is no array of numbers or texts"
    return UserError(f"{path} is damaged, or ends in the middle: {reason}")


def _texts(path: Path) -> Opened:
    """Everything as texts, so that the kind of a column does not hang on its first rows."""
    from pyarrow import csv as reader

    with _damage(path):
        first = _first_line(path)
    delimiter = "\t" if "\t" in first else ";" if first.count(";") > first.count(",") else ","
    names = [name.strip() for name in next(csv.reader(io.StringIO(first), delimiter=delimiter), [])]
    if not names:
        raise UserError(f"{path} is empty.")
    headed = not all(_is_number(name) or name in EMPTY for name in names)
    if not headed:
        names = [str(k) for k in range(len(names))]
    _no_name_twice(names, f"{path}: ")
    texts = pa.string()
    settings: dict[str, Any] = {
        "read_options": reader.ReadOptions(column_names=names, skip_rows=int(headed), use_threads=False),
        "parse_options": reader.ParseOptions(delimiter=delimiter),
        "convert_options": reader.ConvertOptions(
            column_types=dict.fromkeys(names, texts), strings_can_be_null=False
        ),
    }

    def batches() -> Iterator[Any]:
        try:
            yield from reader.open_csv(path, **settings)
        except pa.ArrowInvalid as error:
            if "Empty CSV" in str(error) or "no data" in str(error).lower():
                return
            if ragged := _RAGGED.search(str(error)):
                row, expected, got = map(int, ragged.groups())
                raise UserError(
                    f"{path}, row {row - headed}: expected {expected} cells, found {got}. The file ends in the "
                    "middle, or a cell with a delimiter in it is not in quotes."
                ) from error
            raise

    return Opened(batches(), headed)


_RAGGED = re.compile(r"Row #(\d+): Expected (\d+) columns, got (\d+)")
"""What Arrow says of a line with too few or too many cells, which it counts from 1."""


def _first_line(path: Path) -> str:
    import bz2

    open_text: Any = {".gz": gzip.open, ".bz2": bz2.open}.get(path.suffix.lower(), open)
    try:
        with open_text(path, "rt", encoding="utf-8-sig", newline="") as file:
            return str(file.readline())
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is not text in UTF-8 (byte {error.start}).") from error


def _is_number(text: str) -> bool:
    return bool(Cells(pa.array([text])).spell_numbers[0])


def _parquet(path: Path) -> Opened:
    from pyarrow import parquet

    with _damage(path):
        file = parquet.ParquetFile(path)
        _no_name_twice(file.schema_arrow.names, f"{path}: ")
    return Opened(file.iter_batches(batch_size=ROWS), True, file.metadata.num_rows)


def _excel(path: Path) -> Opened:
    try:
        import pandas as pd

        frame = pd.read_excel(path, dtype=str, keep_default_na=False)
    except ImportError as error:
        raise UserError(f"{path}: to read Excel files, {error.msg}: pip install pandas openpyxl.") from error
    except Exception as error:  # as many kinds as there are formats and parts of them
        raise _damaged(path, error) from error
    return of_frame(frame)


def _array(path: Path, ending: str, key: str | None) -> Opened:
    with _damage(path):
        if ending == ".npy":
            with opened_arrays(path, mapped=True) as found:
                if found.alone is None:
                    raise UserError(f"{path} holds several arrays: let its name end in .npz.")
                return of_array(found.alone, f"{path}: ")
        if ending == ".npz":
            return _npz(path, key)
        try:
            import h5py
        except ImportError as error:
            raise UserError(f"{path}: HDF5 needs h5py, which is not installed: pip install h5py.") from error
        names: list[str] = []
        with h5py.File(path, "r") as file:
            file.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
            name = _chosen(names, key, path)
            array = _Dataset(path, name, file[name].shape, file[name].dtype)
        return of_array(array, f"{path}: ")


@dataclass(frozen=True)
class _Dataset:
    """An array of an HDF5 file, which is open only while rows are read."""

    path: Path
    name: str
    shape: tuple[int, ...]
    dtype: Any

    def __getitem__(self, rows: slice) -> Any:
        import h5py

        with h5py.File(self.path, "r") as file:
            return file[self.name][rows]


def _npz(path: Path, key: str | None) -> Opened:
    with opened_arrays(path) as file:
        if file.alone is not None:
            return of_array(file.alone, f"{path}: ")
        names = list(file.names)
        if {"format", "shape", "data"} <= set(names):
            return of_array(_sparse(path, {name: file[name] for name in names}), f"{path}: ")
        if key is None and len(names) > 1 and not {"x", "X"} & set(names):
            columns = {name: file[name] for name in names}
            if all(column.ndim == 1 for column in columns.values()) and len({*map(len, columns.values())}) == 1:
                return of_frame(pa.table({name: pa.array(column) for name, column in columns.items()}))
        return of_array(file[_chosen(names, key, path)], f"{path}: ")


def _sparse(path: Path, parts: dict[str, Any]) -> Any:
    """A matrix of SciPy; ``parts`` have been read once, so that none is larger than the file."""
    from scipy.sparse import load_npz

    if parts["shape"].shape != (2,):
        raise UserError(f"{path}: a sparse array of shape {parts['shape'].tolist()}: expected rows and columns.")
    found = load_npz(path)
    if hasattr(found, "check_format"):
        found.check_format(full_check=True)  # SciPy's loops write where indices say, whatever they are
    return found.tocsr()


def _chosen(names: list[str], key: str | None, path: Path) -> str:
    if key is None:
        key = next((name for name in names if len(names) == 1 or name.lower() == "x"), None)
    if not names:
        raise UserError(f"{path} holds no array.")
    if key not in names:
        meant = (
            "x, or choose one in training by data=arrays data.key=NAME"
            if key is None
            else f"{key}, as in training"
        )
        raise UserError(f"{path} holds the arrays {', '.join(names)}: call the one that is meant {meant}.")
    return key


def rows_at_once(n_columns: int) -> int:
    """Rows that are held at a time, fewer of many columns."""
    return max(1, min(ROWS, 2**22 // max(1, n_columns)))


def _rows_of(array: Any) -> Iterator[Any]:
    """Record batches of a matrix, whose columns are named by their numbers."""
    n, n_columns = array.shape[0], int(np.prod(array.shape[1:]))
    names = [str(k) for k in range(n_columns)]
    rows = rows_at_once(n_columns)
    for begin in range(0, n, rows):
        part = array[begin : begin + rows]
        part = part.toarray() if hasattr(part, "toarray") else np.asarray(part)
        part = np.ascontiguousarray(part.reshape(len(part), -1).T)
        if part.dtype.kind == "f":  # of other byte orders and lengths, too
            part = part.astype(np.float32 if part.dtype.itemsize < 8 else np.float64, copy=False)
        elif part.dtype.kind in "iu":
            part = part.astype(part.dtype.newbyteorder("="), copy=False)
        yield pa.record_batch([pa.array(column) for column in part], names=names)
