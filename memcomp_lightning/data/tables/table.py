"""Tables from files, frames and arrays, as data of a training."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch

from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.data.rows import UNLABELLED, Origin, Rows, Share
from memcomp_lightning.data.tables.columns import Words
from memcomp_lightning.data.tables.find import Summary, find, roles_of
from memcomp_lightning.data.tables.parts import Joined, Part, files_of, parts_of
from memcomp_lightning.data.tables.passes import (
    EvenlySpaced,
    all_rows,
    blocks_of,
    dealt,
    holders_of,
    order_of,
    summaries_of,
)
from memcomp_lightning.data.tables.readers import Opened, of_array, of_frame
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
        share: Of all rows that this process holds: then ``train`` and ``test`` are its own alone.
        missing: Share of the cells of all rows that are empty.
        origin: The files of a table in several.
    """

    train: Rows
    test: Rows
    validation: Rows | None
    schema: TableSchema
    name: str
    layout: PixelLayout | None = None
    ignored: Mapping[str, str] = field(default_factory=dict)
    minus_one: int = 0
    share: Share | None = None
    missing: float = 0.0
    origin: Origin | None = None

    @property
    def n_train(self) -> int:
        """Training rows, in all processes."""
        return self.train.n if self.share is None else len(self.share.train)

    @property
    def n_test(self) -> int:
        """Test rows, in all processes."""
        return self.test.n if self.share is None or self.share.test is None else len(self.share.test)

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
        if self.share is not None:  # the others' rows are not here
            return {}
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
        path: CSV or TSV (also .gz), Parquet, Excel, ``.npy``, ``.npz`` (arrays or sparse), HDF5; or a folder or a
            pattern of such files with the same columns, which are read as one in the order of their names.
        columns: Kinds by column: ``binary``, ``category``, ``real``, ``spin``, ``probability`` or ``ignore``; the
            name ``all`` stands for all others; ``label`` and ``weight`` name columns.
        validation: A file of rows to look at while training, with the same columns.
        test: A file of test rows; None splits off some of ``path``.
        test_fraction: Share of the rows that is split off, in (0, 1).
        split_seed: Seed of that split.
        key: Which array of an ``.npz`` or HDF5 file.
        picture: Height and width, where the columns are the pixels of a picture.
        schema: What the columns are, of an earlier training on such rows; None finds it out.
        share: Number of this process, and of all that hold the rows together: each a block of them, of one length
            to one row.
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
    share: tuple[int, int] = (0, 1)

    def __post_init__(self) -> None:
        if self.path is None:
            raise UserError("data.path names no file: type data.path=FILE, as in data.path=people.csv.")
        in_range = isinstance(self.test_fraction, int | float) and 0 < self.test_fraction < 1
        require(in_range, "data.test_fraction", self.test_fraction, "a number in (0, 1)")
        require_count("data.split_seed", self.split_seed, 0)

    @property
    def in_parts(self) -> bool:
        """Whether the rows are in several files, which several processes may share."""
        return len(files_of(str(self.path))) > 1

    @property
    def labelled(self) -> bool:
        """Whether a column of classes is named, whose rows each process holds."""
        return "label" in roles_of(_named(self.columns))

    def load(self) -> TableData:
        """Read the files.

        Raises:
            UserError: A file, a column or a cell is not as it must be; the message names it.
        """
        path = str(self.path)
        parts = parts_of(path, key=self.key)
        files = {"validation": self.validation, "test": self.test}
        return table_data(
            parts,
            name=Path(path).name if len(parts) == 1 else path,
            columns=self.columns,
            further={name: parts_of(file, key=self.key) for name, file in files.items() if file},
            test_fraction=self.test_fraction,
            split_seed=self.split_seed,
            picture=self.picture,
            schema=self.schema,
            key=self.key,
            share=self.share,
        )


def table_data(
    parts: Sequence[Part],
    *,
    name: str,
    columns: Mapping[str, str] | str | None = None,
    further: Mapping[str, Sequence[Part]] | None = None,
    test_fraction: float = 0.1,
    split_seed: int = 0,
    picture: tuple[int, int] | None = None,
    schema: TableSchema | None = None,
    key: str | None = None,
    share: tuple[int, int] = (0, 1),
) -> TableData:
    """Find the columns of a table in one pass over its rows, and make numbers of them in another one.

    Of several processes each looks at all rows in the first pass, and reads its own share alone in the second.

    Kinds and words are those of all rows, so that a rare word among the test rows is no error. Means and scales
    are those of the training rows: to know which these are, rows that are split are counted first.

    Args:
        parts: Of the training rows.
        name: Of the data, for reports and errors.
        columns: As of :class:`Table`.
        further: The ``validation`` and ``test`` rows, where they are apart; each process holds all of them.
        test_fraction: Share of the rows that is split off.
        split_seed: Seed of that split.
        picture: Height and width, where the columns are pixels.
        schema: What the columns are; None finds it out.
        key: Of the array in files of several, for the schema.
        share: Number of this process, and of all that share the rows.
    """
    further, given = further or {}, _named(columns)
    order, n_test, several = None, 0, share[1] > 1
    if "test" not in further or several:
        n = sum(part.begin().counted() for part in parts)
        order, n_test = (
            order_of(n, name, test_fraction, split_seed) if "test" not in further else (np.arange(n), 0)
        )
    ignore = {column for column, kind in given.items() if kind == "ignore"}
    trained = None if order is None else order < len(order) - n_test
    joined, some = Joined(parts), EvenlySpaced(name, order) if several else None
    summaries, n, named = summaries_of(joined, name, ignore, trained, some)
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
    apart = {which: all_rows(some, schema) for which, some in further.items()}
    layout = None if picture is None else _layout(picture, schema)
    missing = _missing(summaries, schema)
    sizes, blocks = [n - n_test, n_test], blocks_of(n, share[1])
    masked = True if several and missing > 0 else None  # by all processes alike
    train, rest = dealt(joined, name, schema, sizes, order, blocks[share[0]], masked)
    files = [Path(part.name) for part in parts]
    origin = Origin(files, f"{sizes} {split_seed}", n_test > 0) if len(parts) > 1 else None
    test, validation = apart.get("test", rest), apart.get("validation")
    made = TableData(train, test, validation, schema, name, layout, ignored, missing=missing, origin=origin)
    if some is None or order is None:
        minus_one = _minus_one(summaries, [train, rest], schema)
        return replace(made, minus_one=minus_one)
    holder = holders_of(order, blocks)
    first, last = some.rows(schema, joined, sizes[0], masked)
    return replace(
        made,
        share=Share(
            *share,
            holder[: sizes[0]],
            holder[sizes[0] :] if n_test else None,
            first.rows,
            last.rows if n_test else None,
            first.places,
        ),
    )


def _missing(summaries: list[Summary], schema: TableSchema) -> float:
    """Share of the cells of the columns that the model has that are empty."""
    own = [summary for summary in summaries if summary.name in schema.site_names]
    return sum(summary.n_empty for summary in own) / max(1, sum(summary.n for summary in own))


def _minus_one(summaries: list[Summary], parts: list[Rows], schema: TableSchema) -> int:
    """Rows without a label whose cell is not empty."""
    name = None if schema.label is None else schema.label.name
    empty = next((summary.n_empty for summary in summaries if summary.name == name), None)
    return 0 if empty is None else sum(int((part.label == UNLABELLED).sum()) for part in parts) - empty


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
    return table_data([Part(name, begin)], name=name, **settings)


LABEL = "label"
"""Name of a column of classes that are given beside a table."""


def read_rows(path: Path, schema: TableSchema, *, complete: bool = True) -> Rows:
    """Rows of a file as numbers of the units of a schema; columns may be missing unless ``complete``."""
    return all_rows(parts_of(str(path), key=schema.key), schema, complete=complete)


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


def _table(lines: list[tuple[str, str, str]], data: TableData) -> str:
    """Aligned columns, under a line on the rows."""
    counts = f"{data.n_train:,} rows to train on, {data.n_test:,} test rows"
    if data.validation is not None:
        counts += f", {data.validation.n:,} to look at"
    if data.train.observed is not None:
        missing = 1 - float(data.train.observed.float().mean()) if data.share is None else data.missing
        counts += f", {missing:.1%} of the cells missing"
    if data.share is not None:
        counts += f", shared by {data.share.n_processes} processes"
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
