"""Finds out what the columns of a table are, from one pass over its rows."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.data.tables.cells import Cells
from memcomp_lightning.data.tables.columns import (
    EXACT,
    KINDS,
    Binary,
    Category,
    Column,
    Probability,
    Real,
    SpinColumn,
)
from memcomp_lightning.errors import UserError

MOST_WORDS = 100
"""Different texts of a column that is taken for a category."""

MOST_WHOLE = 10
"""Different whole numbers of a column that is taken for a category."""

FEW_ROWS = 20
"""From so many rows on, whole numbers that rise from row to row are a key."""

_KEPT = 1000
"""Different cells that are remembered; a category may not have more."""


@dataclass
class Summary:
    """What is known of a column after some of its rows.

    Attributes:
        name: Of the column.
        n: Rows.
        n_empty: Empty cells.
        n_numbers: Cells that are numbers.
        odd: The first cell that is no number, and its row from 1; None where there is none. Of several files the
            row is told with its file.
        distinct: Different cells, None where they are more than a thousand.
        n_known: Cells of training rows that are not empty.
        mean, squares: Of the numbers in training rows: mean, and sum of squared deviations.
        varies: Whether the numbers in training rows differ.
        uneven: The first number that is not whole, as it stands, and its row from 1; None where there is none.
        counts: Whether the numbers go up by one from row to row.
        rises: Whether they are whole and go up from row to row, by any step.
    """

    name: str
    n: int = 0
    n_empty: int = 0
    n_numbers: int = 0
    odd: tuple[int | str, str] | None = None
    distinct: set[Any] | None = field(default_factory=set)
    n_known: int = 0
    mean: float = 0.0
    squares: float = 0.0
    varies: bool = False
    uneven: tuple[int | str, str] | None = None
    counts: bool = True
    rises: bool = True
    _first: float = math.nan
    _some: float = math.nan
    _last: float = -math.inf

    def add(self, cells: Cells, trained: NDArray[np.bool_] | None = None) -> None:
        """Take in some more rows.

        Args:
            cells: Of these rows.
            trained: Which of them are training rows; None is all.
        """
        empty, spelt = cells.empty, cells.spell_numbers
        odd = ~empty & ~spelt
        if self.odd is None and odd.any():
            at = int(odd.argmax())
            self.odd = self.n + at + 1, str(cells.array[at].as_py())
        if self.distinct is not None:
            self.distinct |= cells.distinct()
            if len(self.distinct) > _KEPT:
                self.distinct = None
        known = ~empty if trained is None else ~empty & trained
        if self.odd is None:
            numbers = cells.numbers()
            uneven = ~empty & (numbers != np.round(numbers))
            if self.uneven is None and uneven.any():
                at = int(uneven.argmax())
                self.uneven = self.n + at + 1, str(cells.array[at].as_py())
            self._add_numbers(numbers, known)
        self.n_known += int(known.sum())
        self.n_numbers += int(spelt.sum())
        self.n_empty += int(empty.sum())
        self.n += len(empty)

    def _add_numbers(self, numbers: Any, known: Any) -> None:
        if not len(numbers):  # a part of an Arrow table may have no rows
            return
        if math.isnan(self._first):
            self._first = float(numbers[0]) - self.n
        in_turn = numbers == self._first + self.n + np.arange(len(numbers))
        self.counts = self.counts and self._first.is_integer() and bool(in_turn.all())
        steps = np.diff(numbers, prepend=self._last)
        self.rises = self.rises and bool((steps > 0).all()) and bool((numbers == np.round(numbers)).all())
        self._last = float(numbers[-1])
        x = numbers[known]
        if not len(x):
            return
        if math.isnan(self._some):
            self._some = float(x[0])
        self.varies = self.varies or bool((x != self._some).any())
        n, m, mean = self.n_known, len(x), float(x.mean())
        change = mean - self.mean
        self.mean += change * m / (n + m)
        self.squares += float(np.square(x - mean).sum()) + change**2 * n * m / (n + m)

    @property
    def whole(self) -> bool:
        """Whether all numbers are whole."""
        return self.uneven is None

    @property
    def deviation(self) -> float:
        """Standard deviation of the numbers in training rows."""
        return math.sqrt(self.squares / max(self.n_known, 1))

    @property
    def words(self) -> list[Any]:
        """The different cells in rising order: numbers if all are, else texts."""
        assert self.distinct is not None
        found: list[Any] = list(self.distinct)
        if self.odd is None:
            numbers = sorted({float(x) for x in found})
            return [int(x) for x in numbers] if all(x.is_integer() for x in numbers) else numbers
        return sorted(map(str, found))


@dataclass(frozen=True)
class Found:
    """What a table's columns are.

    Attributes:
        columns: Those that the model has.
        label: The classes, None without labels.
        weight: Name of the column of weights, None without.
        ignored: Why each other column is left out.
    """

    columns: list[Column]
    label: Category | None
    weight: str | None
    ignored: dict[str, str]


def roles_of(given: Mapping[str, str]) -> dict[str, str]:
    """The columns that ``data.columns`` names as label and weight; so may columns themselves be called."""
    return {
        role: given[role]
        for role in ("label", "weight")
        if role in given and given[role] not in (*KINDS, "ignore")
    }


def find(summaries: Sequence[Summary], given: Mapping[str, str], file: str, *, uniform: bool = False) -> Found:
    """Decide on the kind of each column.

    Texts are categories, up to 100 different ones. Numbers of two values are spins if these are -1 and 1, else
    binary; whole numbers of up to 10 values are categories; other numbers are real. A column of numbers that count
    the rows, and one of more different texts, is left out and shown so.

    Args:
        summaries: Of all columns.
        given: ``data.columns``: kinds by name, ``ignore`` among them; ``label`` and ``weight`` name columns. The
            name ``all`` stands for each column that is not named.
        file: Name of the file, for errors.
        uniform: Whether the columns have no names of their own and are all of one kind, as those of an array.

    Raises:
        UserError: A column does not exist, cannot be of its kind, has one value, or mixes numbers and texts.
    """
    by_name = {summary.name: summary for summary in summaries}
    roles = roles_of(given)
    for name in [*(name for name in given if name not in roles and name != "all"), *roles.values()]:
        if name not in by_name:
            known = ", ".join(list(by_name)[:20]) + (", ..." if len(by_name) > 20 else "")
            raise UserError(f"{file} has no column {name!r}, which data.columns names: it has {known}.")
    label = roles.get("label")
    modelled = [summary for summary in summaries if summary.name not in roles.values()]
    common = (
        _of_all([s for s in modelled if s.name not in given], file) if uniform and "all" not in given else None
    )
    columns, ignored = list[Column](), dict[str, str]()
    for summary in modelled:
        name = summary.name
        kind = given.get(name, given.get("all"))
        if kind == "ignore":
            ignored[name] = "ignore was typed"
            continue
        if common is not None and name not in given:
            columns.append(_shared(summary, common, file))
            continue
        reason = _left_out(summary) if kind is None else None
        if reason is not None:
            ignored[name] = reason
            continue
        columns.append(_column(summary, kind, file))
    if not columns:
        raise UserError(f"{file}: no column is left for the model. {_typed('NAME', 'real')}")
    classes = None if label is None else _classes(by_name[label], file, given.get(label))
    return Found(columns, classes, roles.get("weight"), ignored)


def _typed(name: str, kind: str) -> str:
    return f"Type 'data.columns={{{name}: {kind}}}'."


def _split_otherwise(name: str) -> str:
    return f"type another data.split_seed, or 'data.columns={{{name}: ignore}}'."


def _left_out(summary: Summary) -> str | None:
    """Why a column is none for the model."""
    if summary.odd is None and summary.counts and summary.n > 2:
        return "it counts the rows"
    if summary.odd is None and summary.rises and summary.n >= FEW_ROWS:
        return "its whole numbers rise from row to row, as those of a key do"
    if summary.odd is not None and not _is_mixed(summary):
        if summary.distinct is None:
            return f"more than {_KEPT} different texts"
        if len(summary.distinct) > MOST_WORDS:
            return f"{len(summary.distinct)} different texts"
    return None


def _is_mixed(summary: Summary) -> bool:
    return summary.odd is not None and summary.n_numbers > (summary.n - summary.n_empty) / 2


def _kind(summary: Summary, file: str) -> str:
    """The word that fits best."""
    if _is_mixed(summary):
        assert summary.odd is not None
        row, cell = summary.odd
        raise UserError(
            f"{file}, column {summary.name!r}, row {row}: {cell!r} is no number, as {summary.n_numbers} other "
            f"cells are. Correct it, leave it empty, or take all for words. {_typed(summary.name, 'category')}"
        )
    few = summary.distinct is not None
    if summary.odd is not None or (few and len(summary.words) == 2):
        return "spin" if summary.words == [-1, 1] else "binary" if len(summary.words) == 2 else "category"
    if few and summary.whole and len(summary.words) <= MOST_WHOLE:
        return "category"
    return "real"


def _column(summary: Summary, kind: str | None, file: str) -> Column:
    name = summary.name
    place = f"{file}, column {name!r}"
    if summary.n == summary.n_empty:
        raise UserError(f"{place} has no value at all. {_typed(name, 'ignore')}")
    if summary.distinct is not None and len(summary.distinct) == 1 and kind not in ("spin", "probability"):
        value = next(iter(summary.distinct))
        raise UserError(f"{place} has one value, {value}, in all rows: it says nothing. {_typed(name, 'ignore')}")
    if not summary.n_known:
        raise UserError(f"{place} has no value in the training rows: {_split_otherwise(name)}")
    if kind is None:
        kind = _kind(summary, file)
    if kind not in KINDS:
        allowed = ", ".join([*KINDS, "ignore"])
        raise UserError(f"data.columns: {name}: {kind} is not allowed: expected one of {allowed}.")
    if kind in ("binary", "category"):
        if summary.distinct is None:
            raise UserError(f"{place} has more than {_KEPT} different values: too many for a {kind} column.")
        words = _told_apart(summary, place)
        if kind == "binary" and len(words) > 2:
            raise UserError(f"{place} has {len(words)} different values: too many for a binary column.")
        return Binary(name, words) if kind == "binary" else Category(name, words)
    if summary.odd is not None:
        row, cell = summary.odd
        raise UserError(f"{place}, row {row}: {cell!r} is no number: it cannot be {kind}.")
    if kind == "real":
        if not summary.varies:
            value = f"one value, {summary.mean:.7g},"
            raise UserError(f"{place} has {value} in all training rows: {_split_otherwise(name)}")
        return Real(name, summary.mean, summary.deviation, summary.whole)
    return SpinColumn(name) if kind == "spin" else Probability(name)


def _told_apart(summary: Summary, place: str) -> tuple[Any, ...]:
    """The words of a column; a UserError for numbers of which float64 would make one word of two."""
    words = tuple(summary.words)
    large = [word for word in words if not isinstance(word, str) and abs(word) > EXACT]
    if large:
        raise UserError(
            f"{place} has words beyond 2^53, such as {large[0]}, not told apart as numbers: put a letter "
            f"before them. {_typed(summary.name, 'ignore')}"
        )
    return words


def _of_all(summaries: Sequence[Summary], file: str) -> Summary:
    """One summary of all columns of an array."""
    whole = Summary("all columns")
    for summary in summaries:
        if whole.odd is None and summary.odd is not None:
            whole.odd, whole.name = summary.odd, summary.name  # which an error names
        if whole.distinct is not None:
            joined = whole.distinct | summary.distinct if summary.distinct is not None else None
            whole.distinct = None if joined is None or len(joined) > _KEPT else joined
        whole.n, whole.n_empty = whole.n + summary.n, whole.n_empty + summary.n_empty
        whole.n_numbers += summary.n_numbers
        whole.uneven = whole.uneven or summary.uneven
    return whole


def _shared(summary: Summary, common: Summary, file: str) -> Column:
    """A column of an array: of the kind, and with the words, of all columns."""
    words = set(common.words) if common.distinct is not None else None
    if words is not None and common.odd is None and words <= {0, 1}:
        return Binary(summary.name, (0, 1))
    if words is not None and common.odd is None and words <= {-1, 1}:
        return SpinColumn(summary.name)
    kind = _kind(common, file)
    if kind == "real":
        return _column(summary, kind, file)
    return (
        Binary(summary.name, tuple(common.words))
        if kind == "binary"
        else Category(summary.name, tuple(common.words))
    )


def _classes(summary: Summary, file: str, kind: str | None) -> Category:
    """The classes of a column of labels.

    -1 is no class, unless the column is called a category beside, or -1 and 1 are all that there is.
    """
    if kind not in (None, "category", summary.name):
        allowed = "category, where -1 is a class, or nothing"
        raise UserError(
            f"data.columns: {summary.name}: {kind} is not allowed: it is the label: expected {allowed}."
        )
    place = f"{file}, label {summary.name!r}"
    if summary.odd is None and summary.uneven is not None:
        row, cell = summary.uneven
        raise UserError(
            f"{file}, column {summary.name!r}, row {row}: {cell!r} is no class: expected words or whole numbers."
        )
    if summary.distinct is None:
        raise UserError(f"{place} has more than {_KEPT} different values: too many for classes.")
    words = _told_apart(summary, place)
    if words != (-1, 1) and kind != "category":
        words = tuple(word for word in words if word not in (-1, "-1"))
    if len(words) < 2:
        raise UserError(f"{place} has {len(words)} classes, expected two or more. Leave the label out.")
    return Category(summary.name, words)
