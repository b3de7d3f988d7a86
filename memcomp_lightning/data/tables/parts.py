"""Tables in one file or several, read as one."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pyarrow as pa

from memcomp_lightning.data.tables.readers import ENDINGS, Opened, ending_of, opened, rows_at_once
from memcomp_lightning.errors import UserError
from memcomp_lightning.files import meant_by


class Part(NamedTuple):
    """A file of a table, or a table that is no file.

    Attributes:
        name: For errors.
        begin: Begins to read it anew.
    """

    name: str
    begin: Callable[[], Opened]


def files_of(path: str) -> list[Path]:
    """The files of a table, by name: ``path`` itself, the tables in a folder, or the files that match a pattern.

    Raises:
        UserError: There is none.
    """
    found = meant_by(path)
    if Path(path).is_dir():
        found = [file for file in found if ending_of(file) in ENDINGS and not file.name.startswith((".", "_"))]
        if not found:
            raise UserError(
                f"{path}: this folder holds no table. Known are files that end in {', '.join(ENDINGS)}."
            )
    if not found:
        raise UserError(f"{path} matches no file in {Path.cwd()}.")
    return found


def parts_of(path: str, *, key: str | None = None) -> list[Part]:
    """The parts of a table that a path means, see :func:`files_of`."""
    return [Part(str(file), partial(opened, file, key=key)) for file in files_of(path)]


class Joined:
    """The rows of several parts with the same columns, one part after the other.

    Attributes:
        parts: In their order.
        ends: Rows in each part that has been read to its end and in those before it.
        named: Whether the columns have names of their own; known while the rows are read.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = parts
        self.ends: list[int] = []
        self.named = True

    def batches(self) -> Iterator[Any]:
        """All rows, in blocks whose size depends on the number of columns alone."""
        self.ends = []
        return in_blocks(self._as_read())

    def _as_read(self) -> Iterator[Any]:
        names: list[str] | None = None
        n = 0
        for number, part in enumerate(self.parts):
            found = part.begin()
            self.named = found.named if number == 0 else self.named
            for batch in found.batches:
                names = list(batch.schema.names) if names is None else names
                n += batch.num_rows
                yield self._like_first(batch, names, part)
            self.ends.append(n)

    def _like_first(self, batch: Any, names: list[str], part: Part) -> Any:
        own = list(batch.schema.names)
        if own == names:
            return batch
        if other := sorted({*own} ^ {*names}):
            whose = part.name if other[0] in own else self.parts[0].name
            raise UserError(
                f"{part.name} has other columns than {self.parts[0].name}: {other[0]!r} is in {whose} alone."
            )
        return batch.select(names)

    def place(self, row: int) -> str:
        """Number of a row in its part, for people, from its number among all rows; both count from 1."""
        if len(self.parts) == 1:
            return str(row)
        before = [end for end in self.ends if end < row]
        return f"{row - (before[-1] if before else 0)} of {self.parts[len(before)].name}"


def in_blocks(batches: Iterable[Any]) -> Iterator[Any]:
    """The same rows in blocks of one size: what is computed block by block is then the same to the last bit."""
    waiting: list[Any] = []
    n = 0
    for given in batches:
        batch, rows = given, rows_at_once(given.num_columns)
        while n + batch.num_rows >= rows:
            yield _one([*waiting, batch.slice(0, rows - n)])
            batch, waiting, n = batch.slice(rows - n), [], 0
        if batch.num_rows:
            waiting.append(batch)
            n += batch.num_rows
    if waiting:
        yield _one(waiting)


def _one(batches: Sequence[Any]) -> Any:
    """Record batches as one; what is whole numbers here and others there becomes the latter."""
    if len(batches) == 1:
        return batches[0]
    tables = [
        pa.Table.from_batches([pa.record_batch(_plain(batch), names=batch.schema.names)]) for batch in batches
    ]
    try:
        table = pa.concat_tables(tables, promote_options="permissive")
    except pa.ArrowException as error:
        raise UserError(
            f"a column is of another kind in one part than in the one before it: {error}. Write the parts alike."
        ) from error
    columns = [pa.concat_arrays(column.chunks) for column in table.columns]
    return pa.record_batch(columns, names=table.column_names)


def _plain(batch: Any) -> list[Any]:
    """Columns whose chunks can be joined: words of a dictionary stand for themselves."""
    return [
        column.dictionary_decode() if pa.types.is_dictionary(column.type) else column for column in batch.columns
    ]
