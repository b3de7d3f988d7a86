"""Reads sequences as they stand in a file: FASTA, or a table with a column of them."""

import bz2
import gzip
import lzma
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from memcomp_lightning.data.written import SEQUENCE
from memcomp_lightning.errors import UserError

TABLES = (".csv", ".tsv", ".parquet", ".xlsx", ".xls", ".ods")
"""Endings of files that are tables; all others are FASTA."""

PACKED: dict[str, Any] = {".gz": gzip.open, ".bz2": bz2.open, ".xz": lzma.open}
"""How packed files are opened, by their ending."""


@dataclass(frozen=True)
class SequenceFile:
    """Sequences as they stand in a file.

    Attributes:
        path: The file.
        names: First words of the headers; of a table the numbers of the rows, from 1.
        sequences: Without blanks.
        is_table: Whether it is a table.
    """

    path: Path
    names: list[str]
    sequences: list[str]
    is_table: bool

    def place(self, number: int, position: int | None = None) -> str:
        """Where a sequence stands, for errors: file, name and line; ``position`` is that of a sign in it."""
        if self.is_table:
            return f"{self.path}, row {self.names[number]}"
        return f"{self.path}, sequence {self.names[number]!r}, line {self._line(number, position)}"

    def _line(self, number: int, position: int | None) -> int:
        """Line of a header, or of a sign of its sequence, counted from 1."""
        found, seen = -1, 0
        for line_number, line in enumerate(_lines(self.path), start=1):
            if line.startswith(">"):
                found += 1
                if found == number and position is None:
                    return line_number
            elif found == number:
                seen += len("".join(line.split()))
                if position is not None and position < seen:
                    return line_number
        return 1


def read_sequences(path: Path) -> SequenceFile:
    """Read a file by its ending: a table (CSV, TSV, Parquet, Excel), or else FASTA; it may be packed.

    Raises:
        UserError: It does not exist, is damaged, ends in the middle, is empty, or is of another kind.
    """
    if not path.is_file():
        raise UserError(f"{path}: there is no such file.")
    endings = [ending.lower() for ending in path.suffixes if ending.lower() not in PACKED]
    is_table = bool(endings) and endings[-1] in TABLES
    names, sequences = _table(path) if is_table else _fasta(path)
    found = SequenceFile(path, names, sequences, is_table)
    if not sequences:
        raise UserError(f"{path} has no sequence.")
    if "" in sequences:
        empty = sequences.index("")
        at_end = " The file ends in the middle." if not is_table and empty == len(sequences) - 1 else ""
        raise UserError(f"{found.place(empty)}: there is no sequence.{at_end}")
    return found


def _fasta(path: Path) -> tuple[list[str], list[str]]:
    try:
        from Bio.SeqIO.FastaIO import SimpleFastaParser
    except ImportError as error:
        raise UserError(
            f"{path}: FASTA needs Biopython, which is not installed: pip install 'memcomp-lightning[tables]'."
        ) from error
    names: list[str] = []
    sequences: list[str] = []
    parse: Any = SimpleFastaParser  # which has no types
    for title, sequence in parse(_of_fasta(path)):
        words = title.lstrip(">").split()
        names.append(words[0] if words else str(len(names) + 1))
        sequences.append("".join(sequence.split()))
    return names, sequences


def _of_fasta(path: Path) -> Iterator[str]:
    """The lines from the first header on; before it there is nothing that a parser might skip in silence."""
    begun = False
    for number, line in enumerate(_lines(path), start=1):
        if not begun and line.strip() and not line.startswith(">"):
            raise UserError(
                f"{path}, line {number}: {line.strip()[:40]!r} is no FASTA, which begins with '>' and a name. "
                f"A table ends in .csv and has a column {SEQUENCE!r}."
            )
        begun = begun or line.startswith(">")
        if begun:
            yield line


def _lines(path: Path) -> Iterator[str]:
    """Lines of a file that may be packed; bytes that are no text are left for the check of the letters."""
    open_text = PACKED.get(path.suffix.lower(), open)
    try:
        with open_text(path, "rt", encoding="utf-8-sig", errors="replace") as file:
            yield from file
    except (OSError, EOFError, lzma.LZMAError) as error:
        raise UserError(f"{path} is damaged, or ends in the middle: {error}") from error


def _table(path: Path) -> tuple[list[str], list[str]]:
    try:
        from memcomp_lightning.data.tables.readers import opened
    except ImportError as error:
        raise UserError(
            f"{path}: tables need Arrow, which is not installed: pip install 'memcomp-lightning[tables]'."
        ) from error
    sequences: list[str] = []
    for batch in opened(path).batches:
        if SEQUENCE not in batch.schema.names:
            held = ", ".join(map(repr, batch.schema.names))
            raise UserError(f"{path} has no column {SEQUENCE!r}; it has {held}. Name the column so.")
        cells = batch.column(SEQUENCE).to_pylist()
        sequences += ["".join(str(cell).split()) if cell is not None else "" for cell in cells]
    return [str(k + 1) for k in range(len(sequences))], sequences
