"""The two passes over the rows of a table: what its columns are, and its rows as numbers of the units."""

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import torch
from numpy.typing import NDArray

from memcomp_lightning import rng
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.tables.cells import CellError, Cells
from memcomp_lightning.data.tables.find import Summary
from memcomp_lightning.data.tables.parts import Joined, Part
from memcomp_lightning.data.tables.schema import Encoded, TableSchema
from memcomp_lightning.errors import UserError, require

MOST_NUMBERS = 2**22
"""Of the evenly spaced rows that each process holds, where each holds a share of the others."""


def order_of(n: int, name: str, test_fraction: float, split_seed: int) -> tuple[NDArray[np.int64], int]:
    """Place of each row among training and then test rows, and how many of these there are."""
    _require_rows(n, name)
    n_test = round(test_fraction * n)
    allowed = f"a share that leaves at least 1 of the {n} rows on each side"
    require(1 <= n_test < n, "data.test_fraction", test_fraction, allowed)
    generator = rng.stream(split_seed, "test rows")
    return torch.randperm(n, generator=generator, device="cpu").numpy(), n_test


def blocks_of(n: int, n_processes: int) -> list[range]:
    """Rows of each process, as they follow each other in the files."""
    bounds = [k * n // n_processes for k in range(n_processes + 1)]
    return [range(*pair) for pair in pairwise(bounds)]


def holders_of(order: NDArray[np.int64], blocks: Sequence[range]) -> torch.Tensor:
    """The process that holds each row, in the order of their places."""
    holder = np.empty(len(order), dtype=np.int16)
    for rank, block in enumerate(blocks):
        holder[order[block.start : block.stop]] = rank
    return torch.from_numpy(holder)


class Placed(NamedTuple):
    """Rows, and their places among all training or all test rows."""

    rows: Rows
    places: torch.Tensor


class EvenlySpaced:
    """Evenly spaced rows of all, which are kept as they were read until it is known what the columns are."""

    def __init__(self, name: str, order: NDArray[np.int64] | None) -> None:
        assert order is not None
        self._name, self._order, self._step, self._n = name, order, 0, 0
        self._kept: list[Any] = []
        self._numbers: list[int] = []

    def add(self, batch: Any) -> None:
        """Keep some of the next rows."""
        self._step = self._step or -(-len(self._order) * batch.num_columns // MOST_NUMBERS)
        places = self._order[self._n : self._n + batch.num_rows]
        chosen = np.flatnonzero(places % self._step == 0)
        self._kept.append(batch.take(pa.array(chosen)))
        self._numbers += (self._n + chosen).tolist()
        self._n += batch.num_rows

    def rows(self, schema: TableSchema, joined: Joined, n_train: int, masked: bool | None) -> list[Placed]:
        """Those among the training rows and those among the test rows, each in the order of their places."""
        step = -(-len(self._order) * schema.units().n // MOST_NUMBERS)
        places = self._order[self._numbers]
        fewer = np.flatnonzero(places % (-(-step // self._step) * self._step) == 0)
        in_turn = fewer[np.argsort(places[fewer])]
        encoded, first = list[Encoded](), 0
        for batch in self._kept:
            names = [joined.place(number + 1) for number in self._numbers[first : first + batch.num_rows]]
            first += batch.num_rows
            encoded.append(schema.encode(batch, self._name, names))
        self._kept = []
        v, label = (
            np.concatenate(parts)[in_turn] for parts in ([e.v for e in encoded], [e.label for e in encoded])
        )
        weights = [part.weight for part in encoded if part.weight is not None]
        weight = np.concatenate(weights)[in_turn] if weights else None
        n = int((places[in_turn] < n_train).sum())
        found = []
        for part, begin in ((slice(None, n), 0), (slice(n, None), n_train)):
            own = None if weight is None else torch.from_numpy(weight[part].copy())
            rows = _rows(torch.from_numpy(v[part].copy()), torch.from_numpy(label[part].copy()), own, masked)
            found.append(Placed(rows, torch.from_numpy(places[in_turn[part]] - begin)))
        return found


def summaries_of(
    joined: Joined,
    name: str,
    skipped: Collection[str],
    trained: NDArray[np.bool_] | None,
    kept: EvenlySpaced | None,
) -> tuple[list[Summary], int, bool]:
    """What is known of each column, how many rows there are, and whether the columns have names of their own."""
    summaries: list[Summary] = []
    for batch in joined.batches():
        first = summaries[0].n if summaries else 0
        if kept is not None:
            kept.add(batch)
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
                row, cell = joined.place(summary.n + error.row + 1), column[error.row].as_py()
                raise UserError(
                    f"{name}, column {summary.name!r}, row {row}: {cell!r} is not allowed: expected "
                    f"{error.expected}. Type 'data.columns={{{summary.name}: ignore}}' to leave the column out."
                ) from error
    n = summaries[0].n if summaries else 0
    _require_rows(n, name)
    for summary in summaries if len(joined.parts) > 1 else ():
        for which in ("odd", "uneven"):
            if (cell := getattr(summary, which)) is not None:
                setattr(summary, which, (joined.place(cell[0]), cell[1]))
    return summaries, n, joined.named


def all_rows(parts: Sequence[Part], schema: TableSchema, *, complete: bool = True) -> Rows:
    """All rows of files that are small enough to be joined."""
    v, label, weight, n = list[NDArray[Any]](), list[NDArray[Any]](), list[NDArray[Any]](), 0
    for file, begin in parts:
        found, first = begin(), 0
        for batch in found.batches:
            if not found.named:
                _check_width(batch.schema.names, schema, file)
            rows = range(first + 1, first + batch.num_rows + 1)
            part = schema.encode(batch, file, rows, complete=complete)
            _check_rows(part.v, file, rows, required=complete)
            v.append(part.v)
            label.append(part.label)
            if part.weight is not None:
                weight.append(part.weight)
            first += batch.num_rows
        n += first
    if not n:
        raise UserError(f"{parts[0].name} has no rows.")
    joined = [torch.from_numpy(_joined(parts)) for parts in (v, label, weight) if parts]
    return _rows(joined[0], joined[1], joined[2] if len(joined) > 2 else None)


def dealt(
    joined: Joined,
    name: str,
    schema: TableSchema,
    sizes: list[int],
    order: NDArray[np.int64] | None,
    block: range,
    masked: bool | None,
) -> list[Rows]:
    """A block of the rows of a table, dealt into sets, each row written where it belongs: none is held twice.

    Args:
        joined: The table, which has been read once.
        name: Of the table, for errors.
        schema: Of the columns.
        sizes: Of the sets, over all rows.
        order: Place of each row over all sets, one after the other; None keeps the order of the table.
        block: The rows that are taken.
        masked: As of :func:`_rows`.
    """
    own = np.arange(block.start, block.stop) if order is None else order[block.start : block.stop]
    bounds = list(pairwise(np.cumsum([0, *sizes])))
    places = [np.sort(own[(own >= begin) & (own < end)]) for begin, end in bounds]
    v = [torch.empty(len(some), schema.n_sites, dtype=torch.float32, device="cpu") for some in places]
    label = [torch.empty(len(some), dtype=torch.long, device="cpu") for some in places]
    weight = [torch.empty(len(some), dtype=torch.float32, device="cpu") for some in places]
    for first, part in _encoded(joined, name, schema, block):
        begin = first - block.start
        to = own[begin : begin + len(part.v)]
        for k, (lowest, end) in enumerate(bounds):
            here = (to >= lowest) & (to < end)
            at = torch.from_numpy(np.searchsorted(places[k], to[here]))
            v[k][at] = torch.from_numpy(part.v[here])
            label[k][at] = torch.from_numpy(part.label[here])
            if part.weight is not None:
                weight[k][at] = torch.from_numpy(part.weight[here])
    weighted = schema.weight is not None
    return [_rows(v[k], label[k], weight[k] if weighted else None, masked) for k in range(len(sizes))]


def _encoded(joined: Joined, name: str, schema: TableSchema, block: range) -> Iterator[tuple[int, Encoded]]:
    """A block of the rows as numbers, each batch with the number of its first row; other files are not read."""
    for part, (begin, end) in zip(joined.parts, pairwise([0, *joined.ends]), strict=True):
        if end <= block.start or begin >= block.stop:
            continue
        file, first = name if len(joined.parts) == 1 else part.name, begin
        for batch in part.begin().batches:
            lowest = max(first, block.start)
            n = min(first + batch.num_rows, block.stop) - lowest
            if n > 0:
                rows = range(lowest - begin + 1, lowest - begin + n + 1)
                encoded = schema.encode(batch.slice(lowest - first, n), file, rows)
                _check_rows(encoded.v, file, rows)
                yield lowest, encoded
            first += batch.num_rows
        if first != end:
            raise UserError(f"{file} has changed while it was read: it had {end - begin:,} rows.")


def _rows(v: torch.Tensor, label: torch.Tensor, weight: torch.Tensor | None, masked: bool | None = None) -> Rows:
    """Rows with the mask of what is missing, which becomes 0 in place; None finds out whether they need one."""
    if masked is None and not bool(v.sum().isnan()):
        return Rows(v, label, None, weight)
    observed = ~v.isnan()
    return Rows(v.nan_to_num_(nan=0.0), label, observed, weight)


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


def _check_rows(v: Any, file: str, rows: range, *, required: bool = True) -> None:
    empty = np.isnan(v).all(axis=1)
    if required and empty.any():
        row = rows[int(empty.argmax())]
        raise UserError(f"{file}, row {row}: every value that the model has is missing. Leave out the row.")


def _require_rows(n: int, name: str) -> None:
    if n < 2:
        raise UserError(f"{name} has {n} rows: expected two or more.")
