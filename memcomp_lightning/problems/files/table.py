"""Lines of two indices and a number: what most formats are made of."""

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.problems.files.comments import unread
from memcomp_lightning.problems.files.numbers import MOST_DIGITS, NUMBER, Numbers, fits
from memcomp_lightning.problems.files.source import Source, counts, filled, holds, is_comment, quoted

HEADER = re.compile(r"\s*(\d+)\s+(\d+)(\s|$)", re.ASCII)


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Lines of one to three numbers.

    Attributes:
        source: The file.
        lines: All of its lines.
        first: How many of them come before the table.
        values: ``(n_rows, 3)``, rounded to float64; a third number that is left out is 1, one alone is the third.
        width: Numbers a line.
    """

    source: Source
    lines: list[str]
    first: int
    values: NDArray[np.float64]
    width: int = 3

    @staticmethod
    def after_header(
        source: Source, lines: list[str], variables: str, entries: str, columns: tuple[int, ...]
    ) -> tuple[int, "Table", list[str]]:
        """The number of variables, the rows, and remarks on what is not read.

        The first line that is no comment says how many variables and rows there are.
        """
        at, header = next(filled(lines), (1, lines[0]))
        match = HEADER.match(header)
        if match is None:
            raise source.fault(quoted(header), f"the numbers of {variables} and {entries}", at)
        n, n_entries = counts(source, at, [match[1], match[2]])
        table = Table.read(source, lines, at, columns)
        if len(table.values) != n_entries:
            raise source.fault(f"{len(table.values)} {entries}", f"{n_entries}, the second number of line {at}")
        rest = header[match.end(2) :].partition("#")[0].strip()
        remarks = [f"Line {at}: {quoted(rest)} after the two numbers is not read."] if rest else []
        return n, table, [*remarks, *unread(lines)]

    @staticmethod
    def read(source: Source, lines: list[str], first: int, columns: tuple[int, ...]) -> "Table":
        """All rows after the first few lines; ``columns`` are the numbers of columns that the format allows."""
        top = next((line.partition("#")[0].split() for _, line in filled(lines, first)), None)
        if top is None:
            return Table(source, lines, first, np.zeros((0, 3)))
        width = len(top) if len(top) in columns else columns[0]
        try:
            rows = lines[first:]
            if holds(rows, "#%/cC"):
                rows = ["" if is_comment(line) else line for line in rows]
            values = np.loadtxt(rows, ndmin=2, comments="#")
        except ValueError as error:
            for number, line in filled(lines, first):
                fields = line.partition("#")[0].split()
                if len(fields) != width or not all(map(NUMBER.fullmatch, fields)):
                    raise source.fault(quoted(line), f"{width} numbers", number) from error
            raise source.fault(f"something else ({error})", f"lines of {width} numbers") from error
        table = Table(source, lines, first, values, width)
        table.check(np.full(len(values), values.shape[1] == width), f"{width} numbers")
        table.check(np.isfinite(values).min(1), "finite numbers")
        if width == 1:
            values = np.insert(values, [0, 0], 0.0, axis=1)
        elif width == 2:
            values = np.insert(values, 2, 1.0, axis=1)
        return Table(source, lines, first, values, width)

    def check(self, good: NDArray[np.bool_], expected: str) -> None:
        """Raise at the first row that is not good."""
        if not np.all(good):
            number, line = self.row(int(np.argmin(good)))
            raise self.source.fault(quoted(line), expected, number)

    def row(self, index: int) -> tuple[int, str]:
        """Number and text of the line of a row."""
        return next(entry for k, entry in enumerate(filled(self.lines, self.first)) if k == index)

    def pairs(self, low: int, high: int, kind: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column counted from 0; ``low`` and ``high`` bound what the file may say."""
        index = self.values[:, :2]
        good = ((index >= low) & (index <= high) & (index == np.floor(index))).min(1, initial=True)
        self.check(good, f"two {kind}, integers from {low} to {high}")
        i, j = (index.astype(np.int64) - low).T
        return i, j

    def numbers(self, constant: str = "0") -> Numbers:
        """The third numbers as they stand in the file, and a constant behind them."""
        values = self.values[:, 2]
        # Below 2^53 float64 reads a number without a point or a power of ten exactly.
        whole = constant == "0" and bool((np.abs(values) < 2**53).all())
        if whole and (self.width == 2 or not holds(self.lines[self.first :], ".eE")):
            return Numbers.whole(np.append(values, 0).astype(np.int64))
        rows = (line.partition("#")[0].split() for _, line in filled(self.lines, self.first))
        words = ["1" if self.width == 2 else row[-1] for row in rows]
        for index, word in enumerate(words):
            if not fits(word):
                number, line = self.row(index)
                expected = f"a number that float64 can hold, of at most {MOST_DIGITS} digits"
                raise self.source.fault(quoted(line), expected, number)
        return Numbers.read([*words, constant])
