"""Tables from files, frames and arrays, as data of a training."""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

from memcomp_lightning import rng
from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.data.rows import UNLABELLED, Rows
from memcomp_lightning.data.tables.cells import CellError, Cells
from memcomp_lightning.data.tables.columns import Words
from memcomp_lightning.data.tables.find import Summary, find
from memcomp_lightning.data.tables.readers import Opened, of_array, of_frame, opened
from memcomp_lightning.data.tables.schema import TableSchema
from memcomp_lightning.errors import UserError, require, require_count
from memcomp_lightning.models.units import Units

Open = Callable[[], Opened]
"""Begins to read a table anew."""


@dataclass(frozen=True, eq=False)
class TableData:
    """A table as a training takes it.

    Attributes:
        train, test: Rows.
        validation: Rows; None where none are given.
        schema: What the units are in the table.
        name: Of the data, for reports.
        layout: Where the columns lie in a picture; None where they are none.
        ignored: Why each column that the model does not have is left out.
        minus_one: Rows of the file without a label because theirs is -1.
    """

    train: Rows
    test: Rows
    validation: Rows | None
    schema: TableSchema
    name: str
    layout: PixelLayout | None = None
    ignored: Mapping[str, str] = field(default_factory=dict)
    minus_one: int = 0

    @property
    def n_classes(self) -> int:
        """Number of classes, 0 without labels."""
        return self.schema.n_classes

    @property
    def n_sites(self) -> int:
        """Columns that the model has."""
        return self.schema.n_sites

    def units(self) -> Units:
        """Visible units for the columns."""
        return self.schema.units()

    def described(self) -> str:
        """The columns with their kinds, for people."""
        lines = [(column.name, column.kind, column.described) for column in self.schema.columns]
        if self.schema.label is not None:
            n_without = int((self.train.label == UNLABELLED).sum())
            name, words = self.schema.label.name, self.schema.label.described
            if n_without:
                words += f"; {n_without:,} training rows have none"
            if self.minus_one:
                typed = f"data.columns={{label: {name}, {name}: category}}"
                keep = f"{typed if name != LABEL else 'another word'} makes a class of it"
                words += f"; -1 is none, in {self.minus_one:,} rows: {keep}"
            elif self.schema.label.words[0] in (-1, "-1"):
                words += "; -1 is a class"
            lines.append((name, "label", words))
        if self.schema.weight is not None:
            lines.append((self.schema.weight, "weight", ""))
        lines += [(name, "ignored", reason) for name, reason in self.ignored.items()]
        return _table(lines, self)

    @property
    def unseen(self) -> dict[str, list[str]]:
        """Words of columns and classes that are in no training row, but in test rows or in a run before."""
        found, (v, label, observed, _) = {}, self.train
        numbers = {
            column: v[:, site] if observed is None else v[observed[:, site], site]
            for site, column in enumerate(self.schema.of_sites)
            if isinstance(column, Words)
        }
        if self.schema.label is not None:
            numbers[self.schema.label] = label[label != UNLABELLED]
        for column, some in numbers.items():
            seen = torch.bincount(some.long(), minlength=len(column.words)).tolist()
            if words := [str(word) for word, n in zip(column.words, seen, strict=True) if not n]:
                found[column.name] = words
        return found


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table in a file: what ``data=table`` and ``data=arrays`` read.

    The kinds of the columns are found in the file, see :func:`memcomp_lightning.data.tables.find.find`.

    Args:
        path: CSV or TSV (also .gz), Parquet, Excel, ``.npy``, ``.npz`` (arrays or sparse), HDF5.
        columns: Kinds by column: ``binary``, ``category``, ``real``, ``spin``, ``probability`` or ``ignore``; the
            name ``all`` stands for all others; ``label`` and ``weight`` name columns.
        validation: A file of rows to look at while training, with the same columns.
        test: A file of test rows; None splits off some of ``path``.
        test_fraction: Share of the rows that is split off, in (0, 1).
        split_seed: Seed of that split.
        key: Which array of an ``.npz`` or HDF5 file.
        picture: Height and width, where the columns are the pixels of a picture.
        schema: What the columns are, of an earlier training on such rows; None finds it out.
    """

    path: str | None = None
    columns: Mapping[str, str] | str | None = None
    validation: str | None = None
    test: str | None = None
    test_fraction: float = 0.1
    split_seed: int = 0
    key: str | None = None
    picture: tuple[int, int] | None = None
    schema: TableSchema | None = None

    def __post_init__(self) -> None:
        if self.path is None:
            raise UserError("data.path names no file: type data.path=FILE, as in data.path=people.csv.")
        in_range = isinstance(self.test_fraction, int | float) and 0 < self.test_fraction < 1
        require(in_range, "data.test_fraction", self.test_fraction, "a number in (0, 1)")
        require_count("data.split_seed", self.split_seed, 0)

    def load(self) -> TableData:
        """Read the files.

        Raises:
            UserError: A file, a column or a cell is not as it must be; the message names it.
        """
        path = Path(str(self.path))
        files = {"validation": self.validation, "test": self.test}
        further: dict[str, tuple[str, Open]] = {
            name: (file, partial(opened, Path(file), key=self.key)) for name, file in files.items() if file
        }
        return table_data(
            partial(opened, path, key=self.key),
            name=path.name,
            columns=self.columns,
            further=further,
            test_fraction=self.test_fraction,
            split_seed=self.split_seed,
            picture=self.picture,
            schema=self.schema,
            key=self.key,
        )


def table_data(
    begin: Open,
    *,
    name: str,
    columns: Mapping[str, str] | str | None = None,
    further: Mapping[str, tuple[str, Open]] | None = None,
    test_fraction: float = 0.1,
    split_seed: int = 0,
    picture: tuple[int, int] | None = None,
    schema: TableSchema | None = None,
    key: str | None = None,
) -> TableData:
    """Find the columns of a table in one pass over its rows, and make numbers of them in another one.

    Kinds and words are those of all rows, so that a rare word among the test rows is no error. Means and scales
    are those of the training rows: to know which these are, rows that are split are counted first.

    Args:
        begin: Begins to read the training rows.
        name: Of the data, for reports and errors.
        columns: As of :class:`Table`.
        further: Names and readings of the ``validation`` and ``test`` rows, where they are apart.
        test_fraction: Share of the rows that is split off.
        split_seed: Seed of that split.
        picture: Height and width, where the columns are pixels.
        schema: What the columns are; None finds it out.
        key: Of the array in files of several, for the schema.
    """
    further, given = further or {}, _named(columns)
    order, n_test = None, 0
    if "test" not in further:
        order, n_test = _order(begin().counted(), name, test_fraction, split_seed)
    ignore = {column for column, kind in given.items() if kind == "ignore"}
    trained = None if order is None else order < len(order) - n_test
    summaries, n, named = _summaries(begin(), name, ignore, trained)
    if schema is None:
        found = find(summaries, given, name, uniform=not named)
        schema, ignored = (
            TableSchema(
                tuple(found.columns), found.label, found.weight, named, key, None if named else len(summaries)
            ),
            found.ignored,
        )
    else:
        ignored = _besides(schema, [summary.name for summary in summaries])
    apart = {part: _whole(reading(), file, schema) for part, (file, reading) in further.items()}
    layout = None if picture is None else _layout(picture, schema)
    parts = _split(begin(), name, schema, [n - n_test, n_test], order)
    train, test = parts[0], apart.get("test", parts[1])
    minus_one = _minus_one(summaries, parts, schema)
    return TableData(train, test, apart.get("validation"), schema, name, layout, ignored, minus_one)


def _minus_one(summaries: list[Summary], parts: list[Rows], schema: TableSchema) -> int:
    """Rows without a label whose cell is not empty."""
    name = None if schema.label is None else schema.label.name
    empty = next((summary.n_empty for summary in summaries if summary.name == name), None)
    return 0 if empty is None else sum(int((part.label == UNLABELLED).sum()) for part in parts) - empty


def _order(n: int, name: str, test_fraction: float, split_seed: int) -> tuple[NDArray[np.int64], int]:
    """Place of each row among training and then test rows, and how many of these there are."""
    _require_rows(n, name)
    n_test = round(test_fraction * n)
    allowed = f"a share that leaves at least 1 of the {n} rows on each side"
    require(1 <= n_test < n, "data.test_fraction", test_fraction, allowed)
    generator = rng.stream(split_seed, "test rows")
    return torch.randperm(n, generator=generator, device="cpu").numpy(), n_test


def _require_rows(n: int, name: str) -> None:
    if n < 2:
        raise UserError(f"{name} has {n} rows: expected two or more.")


def data_of(table: Any, label: Any = None, *, name: str = "table", **settings: Any) -> TableData:
    """Data of a DataFrame, a table of Arrow, or a matrix of NumPy, SciPy or torch.

    Args:
        table: The rows.
        label: Classes of the rows, one each, -1 where there is none; None without, or with those of a column.
        name: Of the data, for reports.
        settings: ``columns``, ``test_fraction``, ``split_seed``, ``picture``, as of :class:`Table`.
    """
    is_frame = hasattr(table, "columns") or hasattr(table, "column_names")
    begin: Open = partial(of_frame if is_frame else of_array, table)
    if label is not None:
        settings["columns"] = {**_named(settings.get("columns")), "label": LABEL}
        begin = partial(_beside, begin, np.asarray(label))
    return table_data(begin, name=name, **settings)


LABEL = "label"
"""Name of a column of classes that are given beside a table."""


def read_rows(path: Path, schema: TableSchema, *, complete: bool = True) -> Rows:
    """Rows of a file as numbers of the units of a schema; columns may be missing unless ``complete``."""
    return _whole(opened(path, key=schema.key), str(path), schema, complete=complete)


def _besides(schema: TableSchema, names: list[str]) -> dict[str, str]:
    """Why each of the other columns of a table is left out."""
    label = None if schema.label is None else schema.label.name
    own = {*schema.site_names, label, schema.weight}
    return {name: "the model does not have it" for name in names if name not in own}


def _named(columns: Mapping[str, str] | str | None) -> dict[str, str]:
    if isinstance(columns, str):
        return {"all": columns}
    return {str(name): str(kind) for name, kind in (columns or {}).items()}


def _beside(begin: Open, label: Any) -> Opened:
    """A reading with one column more."""
    found = begin()

    def batches() -> Any:
        first = 0
        for batch in found.batches:
            part = label[first : first + batch.num_rows]
            first += batch.num_rows
            if len(part) == batch.num_rows:
                yield pa.record_batch([*batch.columns, pa.array(part)], names=[*batch.schema.names, LABEL])
        if first != len(label):
            raise UserError(f"{len(label)} labels for {first} rows: expected one for each row.")

    return found._replace(batches=batches())


def _layout(picture: tuple[int, int], schema: TableSchema) -> PixelLayout:
    height, width = picture
    n = schema.n_sites
    require(height * width == n, "data.picture", tuple(picture), f"height and width of {n} pixels, one a column")
    alike = len({column.kind for column in schema.columns}) == 1
    require(alike, "data.picture", tuple(picture), "null where the columns are of several kinds")
    return PixelLayout(height, width)


def _summaries(
    found: Opened, name: str, skipped: Collection[str], trained: NDArray[np.bool_] | None
) -> tuple[list[Summary], int, bool]:
    """What is known of each column, how many rows there are, and whether the columns have names of their own."""
    summaries: list[Summary] = []
    for batch in found.batches:
        first = summaries[0].n if summaries else 0
        some = None if trained is None else trained[first : first + batch.num_rows]
        if not summaries:
            summaries = [Summary(str(column)) for column in batch.schema.names]
        for summary, column in zip(summaries, batch.columns, strict=True):
            if summary.name in skipped:
                summary.n += batch.num_rows
                continue
            try:
                summary.add(Cells(column), some)
            except CellError as error:
                row, cell = summary.n + error.row + 1, column[error.row].as_py()
                raise UserError(
                    f"{name}, column {summary.name!r}, row {row}: {cell!r} is not allowed: expected "
                    f"{error.expected}. Type 'data.columns={{{summary.name}: ignore}}' to leave the column out."
                ) from error
    n = summaries[0].n if summaries else 0
    _require_rows(n, name)
    return summaries, n, found.named


def _whole(found: Opened, file: str, schema: TableSchema, *, complete: bool = True) -> Rows:
    """All rows of a file that is small enough to be joined."""
    v, label, weight, first = list[NDArray[Any]](), list[NDArray[Any]](), list[NDArray[Any]](), 0
    for batch in found.batches:
        if not found.named:
            _check_width(batch.schema.names, schema, file)
        part = schema.encode(batch, file, first, complete=complete)
        _check_rows(part.v, file, first, required=complete)
        v.append(part.v)
        label.append(part.label)
        if part.weight is not None:
            weight.append(part.weight)
        first += batch.num_rows
    if not first:
        raise UserError(f"{file} has no rows.")
    joined = [torch.from_numpy(_joined(parts)) for parts in (v, label, weight) if parts]
    return _rows(joined[0], joined[1], joined[2] if len(joined) > 2 else None)


def _joined(parts: list[NDArray[Any]]) -> NDArray[Any]:
    """Arrays one after the other; each is let go when it is copied, so that the rows are not held twice."""
    found = np.empty((sum(map(len, parts)), *parts[0].shape[1:]), parts[0].dtype)
    end = len(found)
    while parts:
        part = parts.pop()
        found[end - len(part) : end] = part
        end -= len(part)
    return found


def _check_width(names: list[str], schema: TableSchema, file: str) -> None:
    """Refuse an array of another width, whose numbered columns would be taken for those of the model."""
    if schema.width is not None and not (set(schema.site_names) <= set(names) and len(names) <= schema.width):
        raise UserError(f"{file} has {len(names)} columns: expected {schema.width}, as the array of the training.")


def _split(found: Opened, file: str, schema: TableSchema, sizes: list[int], order: Any) -> list[Rows]:
    """Rows of a file in parts of these sizes, each written where it belongs: no table is held twice.

    Args:
        found: The reading.
        file: Its name, for errors.
        schema: Of the columns.
        sizes: Of the parts.
        order: Place of each row over all parts, one after the other; None keeps the order of the file.
    """
    v = [torch.empty(size, schema.n_sites, dtype=torch.float32, device="cpu") for size in sizes]
    label = [torch.empty(size, dtype=torch.long, device="cpu") for size in sizes]
    weight = [torch.empty(size, dtype=torch.float32, device="cpu") for size in sizes]
    begins = np.cumsum([0, *sizes])
    first = 0
    for batch in found.batches:
        part = schema.encode(batch, file, first)
        _check_rows(part.v, file, first)
        places = (
            np.arange(first, first + batch.num_rows) if order is None else order[first : first + batch.num_rows]
        )
        for k in range(len(sizes)):
            here = (places >= begins[k]) & (places < begins[k + 1])
            at = torch.from_numpy(places[here] - begins[k])
            v[k][at] = torch.from_numpy(part.v[here])
            label[k][at] = torch.from_numpy(part.label[here])
            if part.weight is not None:
                weight[k][at] = torch.from_numpy(part.weight[here])
        first += batch.num_rows
    weighted = schema.weight is not None
    return [_rows(v[k], label[k], weight[k] if weighted else None) for k in range(len(sizes))]


def _rows(v: torch.Tensor, label: torch.Tensor, weight: torch.Tensor | None) -> Rows:
    """Rows with the mask of what is missing, which becomes 0 in place."""
    if not bool(v.sum().isnan()):
        return Rows(v, label, None, weight)
    observed = ~v.isnan()
    return Rows(v.nan_to_num_(nan=0.0), label, observed, weight)


def _check_rows(v: Any, file: str, first_row: int, *, required: bool = True) -> None:
    empty = np.isnan(v).all(axis=1)
    if required and empty.any():
        row = first_row + int(empty.argmax()) + 1
        raise UserError(f"{file}, row {row}: every value that the model has is missing. Leave out the row.")


def _table(lines: list[tuple[str, str, str]], data: TableData) -> str:
    """Aligned columns, under a line on the rows."""
    n, n_test = data.train.n, data.test.n
    counts = f"{n:,} rows to train on, {n_test:,} test rows"
    if data.validation is not None:
        counts += f", {data.validation.n:,} to look at"
    if data.train.observed is not None:
        share = 1 - float(data.train.observed.float().mean())
        counts += f", {share:.1%} of the cells missing"
    if len(lines) > MOST_LINES or not data.schema.named:
        kinds = [kind for _, kind, _ in lines]
        by_kind = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
        rows = [f"  {len(lines)} columns: {by_kind}"]
        rows += [f"  {name}  {kind}  {text}" for name, kind, text in lines if kind == "label"]
    else:
        wide = [max(len(line[k]) for line in lines) for k in range(2)]
        rows = [f"  {name:<{wide[0]}}  {kind:<{wide[1]}}  {text}".rstrip() for name, kind, text in lines]
    if unseen := [f"{name} {', '.join(words[:6])}" for name, words in data.unseen.items()]:
        rows.append(f"  in no training row: {'; '.join(unseen[:6])}{'; ...' if len(unseen) > 6 else ''}")
    return "\n".join([f"{data.name}: {counts}", *rows])


MOST_LINES = 60
"""Columns that are shown one by one."""
