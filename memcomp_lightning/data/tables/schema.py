"""What the units of a model are in the user's own table: kept with the model, so that results are in its words."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning.data.rows import UNLABELLED, Rows
from memcomp_lightning.data.schema import Columns
from memcomp_lightning.data.tables.cells import CellError, Cells
from memcomp_lightning.data.tables.columns import Category, Column, Real, column_of
from memcomp_lightning.errors import SettingError, UserError, require
from memcomp_lightning.files import made_of
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Spin, Units, side_by_side


class Encoded(NamedTuple):
    """Some rows of a table as numbers.

    Attributes:
        v: Of the sites, NaN where missing, ``(n, n_sites)`` float32.
        label: Class indices, -1 where there is none, ``(n,)`` int64.
        weight: ``(n,)`` float32; None where the schema has none.
    """

    v: NDArray[np.float32]
    label: NDArray[np.int64]
    weight: NDArray[np.float32] | None


@dataclass(frozen=True)
class TableSchema:
    """The columns of a table, and the units that stand for them.

    The units stand side by side by kind: binary columns and probabilities first, then spins, categories and real
    columns, each in the order of the table.

    Attributes:
        columns: Those that the model has, in the order of the table.
        label: The classes, None without labels.
        weight: Name of the column of weights, None without.
        named: Whether the columns have names of their own; those of arrays are numbered.
        key: Which array of a file of several is read; None is the only one, or ``x``.
        width: Columns that the array had, with those that are left out; None where they have names.
    """

    columns: tuple[Column, ...]
    label: Category | None = None
    weight: str | None = None
    named: bool = True
    key: str | None = None
    width: int | None = None

    @cached_property
    def of_sites(self) -> tuple[Column, ...]:
        """The columns in the order of the sites of the units."""
        places = {"binary": 0, "probability": 0, "spin": 1, "category": 2, "real": 3}
        return tuple(sorted(self.columns, key=lambda column: places[column.kind]))

    @property
    def n_sites(self) -> int:
        """Number of columns that the model has."""
        return len(self.columns)

    @property
    def n_classes(self) -> int:
        """Number of classes, 0 without labels."""
        return 0 if self.label is None else len(self.label.words)

    @property
    def class_names(self) -> list[str]:
        """The classes in words."""
        return [] if self.label is None else [str(word) for word in self.label.words]

    @property
    def entry_names(self) -> list[str]:
        """Names of all visible units; a category has one for each of its values."""
        return [name for column in self.of_sites for name in column.entries]

    @property
    def site_names(self) -> list[str]:
        """Names of the columns in the order of the sites."""
        return [column.name for column in self.of_sites]

    @property
    def log_scales(self) -> list[float]:
        """Log of the scale of each site, 0 of those that are not real."""
        return [math.log(column.scale) if isinstance(column, Real) else 0.0 for column in self.of_sites]

    @property
    def log_scale(self) -> float:
        """Sum of the logs of the scales: what a log density of the units is above one in the user's units."""
        return sum(self.log_scales)

    def units(self) -> Units:
        """Visible units for these columns."""
        kinds = [column.kind for column in self.of_sites]
        sizes = [len(column.words) for column in self.of_sites if isinstance(column, Category)]
        n_bits = kinds.count("binary") + kinds.count("probability")
        layers: list[Units] = [Bernoulli(n_bits)] if n_bits else []
        layers += [Spin(kinds.count("spin"))] if "spin" in kinds else []
        layers += [Categorical(sizes)] if sizes else []
        layers += [Gaussian(kinds.count("real"))] if "real" in kinds else []
        return side_by_side(*layers)

    def encode(
        self, batch: Any, file: str, rows: Sequence[object] | None = None, *, complete: bool = True
    ) -> Encoded:
        """Numbers of some rows.

        Args:
            batch: A record batch of Arrow, with the columns of the schema by name.
            file: Name of the file, for errors.
            rows: What errors call the rows; None counts them from 1.
            complete: Whether every column of the schema must be there; one that is not is missing otherwise.

        Raises:
            UserError: A column is not there, or none of them is; a cell is not what its column can be.
        """
        names, n = set(batch.schema.names), batch.num_rows
        rows = range(1, n + 1) if rows is None else rows
        if complete and self.weight is not None and self.weight not in names:
            raise UserError(f"{file} has no column {self.weight!r}, the weights of the rows.")
        if not names & set(self.site_names):
            own, theirs = (", ".join(map(repr, some[:8])) for some in (self.site_names, batch.schema.names))
            raise UserError(f"{file} has none of the columns of the model, which are {own}; it has {theirs}.")
        v = np.empty((n, self.n_sites), dtype=np.float32)
        for site, column in enumerate(self.of_sites):
            if column.name not in names:
                if complete:
                    raise UserError(f"{file} has no column {column.name!r}, which the model has.")
                v[:, site] = np.nan
                continue
            v[:, site] = _read(column, batch, file, rows)
        return Encoded(v, self._labels(batch, names, file, rows), self._weights(batch, names, file, rows))

    def decode(self, v: Tensor) -> Columns:
        """Rows in the user's columns and words.

        Args:
            v: Numbers of the sites, ``(n, n_sites)``; NaN becomes an empty cell.
        """
        numbers = v.detach().cpu().numpy()
        at = {column.name: site for site, column in enumerate(self.of_sites)}
        return {column.name: column.write(numbers[:, at[column.name]]) for column in self.columns}

    def read(self, path: Path, *, complete: bool = True) -> Rows:
        """Rows of a file with these columns; see :class:`memcomp_lightning.data.schema.Schema`."""
        from memcomp_lightning.data.tables.table import read_rows

        return read_rows(path, self, complete=complete)

    def others(self, path: Path) -> Columns:
        """Columns of a file that the model does not have."""
        from memcomp_lightning.data.tables.filled import others

        return others(path, {column.name for column in self.columns}, key=self.key)

    def filled(self, path: Path, v: Tensor) -> Columns:
        """All columns of a file, its empty cells that the model has a number for filled with those of v."""
        from memcomp_lightning.data.tables.filled import filled

        return filled(path, self, v)

    def as_json(self) -> dict[str, Any]:
        """Plain values, from which :meth:`from_json` makes the schema again."""
        label = None if self.label is None else self.label.as_json()
        columns = [column.as_json() for column in self.columns]
        own = {"data": "table", "named": self.named, "label": label, "weight": self.weight, "columns": columns}
        kept = {name: value for name, value in (("key", self.key), ("width", self.width)) if value is not None}
        return own | kept

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "TableSchema":
        """The schema that was written."""
        plain = made_of(_Plain, dict(content))
        columns = tuple(column_of(column) for column in plain.columns)
        label = None if plain.label is None else column_of(plain.label)
        names = [column.name for column in columns]
        require(0 < len(names) == len(set(names)), "columns of a schema", names, "one or more, each once")
        if not (label is None or isinstance(label, Category)):
            raise SettingError(f"kind of the label = {label.kind!r} is not allowed: expected 'category'.")
        return cls(columns, label, plain.weight, plain.named, plain.key, plain.width)

    def _labels(self, batch: Any, names: set[str], file: str, rows: Sequence[object]) -> NDArray[np.int64]:
        if self.label is None or self.label.name not in names:
            return np.full(batch.num_rows, UNLABELLED, dtype=np.int64)
        cells = Cells(batch.column(self.label.name))
        found = cells.index_of(self.label.words)
        unknown = (
            np.isnan(found) & ~cells.empty & ~np.array([str(x) in ("-1", "-1.0") for x in cells.plain.to_pylist()])
        )
        if unknown.any():
            _refuse(
                self.label.name,
                batch,
                int(unknown.argmax()),
                file,
                rows,
                f"a class of the training data: {self.label.described}",
            )
        return np.where(np.isnan(found), UNLABELLED, found).astype(np.int64)

    def _weights(
        self, batch: Any, names: set[str], file: str, rows: Sequence[object]
    ) -> NDArray[np.float32] | None:
        if self.weight is None or self.weight not in names:
            return None
        try:
            found = Cells(batch.column(self.weight)).numbers()
        except CellError as error:
            _refuse(self.weight, batch, error.row, file, rows, "a number > 0")
        wrong = ~(found > 0)
        if wrong.any():
            _refuse(self.weight, batch, int(wrong.argmax()), file, rows, "a number > 0")
        return found.astype(np.float32)


@dataclass(frozen=True)
class _Plain:
    """A schema as it is written."""

    data: str
    named: bool
    label: dict[str, Any] | None
    weight: str | None
    columns: list[dict[str, Any]]
    key: str | None = None
    width: int | None = None


def _read(column: Column, batch: Any, file: str, rows: Sequence[object]) -> NDArray[np.float32]:
    try:
        return column.read(Cells(batch.column(column.name)))
    except CellError as error:
        _refuse(column.name, batch, error.row, file, rows, error.expected)
        raise AssertionError from error


def _refuse(name: str, batch: Any, row: int, file: str, rows: Sequence[object], expected: str) -> None:
    cell = batch.column(name)[row].as_py()
    raise UserError(f"{file}, column {name!r}, row {rows[row]}: {cell!r} is not allowed: expected {expected}.")
