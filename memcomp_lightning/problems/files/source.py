"""A file and its text: unpacking, lines, comments, and how a fault in it is named."""

import bz2
import gzip
import io
import lzma
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from memcomp_lightning.errors import Told

MOST_VARIABLES = 10**7
"""A larger number of variables is taken for a misprint: the list of their values alone would fill the memory."""

MOST_UNPACKED = 2**30
"""Bytes. A small packed file may hold more than any memory does."""

_MOST_FOLD, _ALWAYS_READ = 1000, 2**26
"""What a packed file may hold: so many times its own bytes, as gzip gives at most, or so many bytes."""


class ProblemFileError(Told, ValueError):
    """A problem file that cannot be read: where the fault is, what was found, what was expected."""


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """A file and its uncompressed bytes."""

    path: Path
    data: bytes

    def fault(self, found: str, expected: str, line: int | None = None) -> ProblemFileError:
        """The error to raise; lines count from 1."""
        where = self.path if line is None else f"{self.path}, line {line}"
        return ProblemFileError(f"{where}: found {found}, expected {expected}.")

    def lines(self) -> list[str]:
        """The lines of a text file; what is not ASCII can only be part of a comment.

        Raises:
            ProblemFileError: The file is empty or no text.
        """
        if b"\0" in self.data[:4096]:
            raise self.fault("binary data", "a text file")
        text = self.data.removeprefix(b"\xef\xbb\xbf").decode("ascii", "replace").translate(_NO_BLANKS)
        lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        if not any(line and not line.isspace() for line in lines):
            raise self.fault("an empty file", "a problem")
        return lines


_NO_BLANKS = dict.fromkeys(range(0x1C, 0x20), "\N{REPLACEMENT CHARACTER}")
"""Signs that Python takes for blanks and no format has: they are no text."""


class Packing(NamedTuple):
    """A way to pack a file: the bytes that it begins with, and how it is read."""

    name: str
    magic: bytes
    open: Callable[[io.BytesIO], io.BufferedIOBase]


PACKINGS = {
    ".gz": Packing("gzip", b"\x1f\x8b", lambda file: gzip.GzipFile(fileobj=file)),
    ".xz": Packing("xz", b"\xfd7zXZ\0", lzma.LZMAFile),
    ".bz2": Packing("bzip2", b"BZh", bz2.BZ2File),
}
"""By the suffix that follows the format's own."""


def unpacked(path: Path, data: bytes) -> bytes:
    """The bytes of a file that may be packed, by its name or its first bytes.

    Raises:
        ProblemFileError: The packed file is damaged, or holds more than ``MOST_UNPACKED`` bytes.
    """
    named = PACKINGS.get(path.suffix.lower())
    packing = named or next((row for row in PACKINGS.values() if data.startswith(row.magic)), None)
    if packing is None:
        return data
    most = min(MOST_UNPACKED, max(_ALWAYS_READ, _MOST_FOLD * len(data)))
    try:
        with packing.open(io.BytesIO(data)) as file:
            content = _read_at_most(file, most + 1)
    except (EOFError, OSError, zlib.error, lzma.LZMAError) as error:
        cause = str(error) or "an error"
        raise ProblemFileError(f"{path}: found {cause}, expected a complete {packing.name} stream.") from error
    if len(content) > most:
        raise ProblemFileError(
            f"{path}: found more than {most // 2**20:,} MiB packed into it, expected at most so much. "
            "Unpack the file yourself if it is what you mean."
        )
    return content


def _read_at_most(file: io.BufferedIOBase, n: int) -> bytes:
    """The first n bytes, without room for all of them before they are there."""
    content = bytearray()
    while len(content) < n and (block := file.read(min(n - len(content), 2**20))):
        content += block
    return bytes(content)


def stem(path: Path) -> Path:
    """The path without what says that the file is packed."""
    return path.with_suffix("") if path.suffix.lower() in PACKINGS else path


def is_comment(line: str) -> bool:
    """Whether a line of a table says nothing: empty, or begun by ``#``, ``%``, ``//`` or the word ``c``."""
    return _COMMENT.match(line) is not None


_COMMENT = re.compile(r"\s*(?:$|[#%]|//|[cC](?:\s|$))", re.ASCII)


def holds(lines: list[str], characters: str) -> bool:
    """Whether any of these characters stands in the lines: a quick look at a million of them."""
    text = "\n".join(lines)
    return any(character in text for character in characters)


def filled(lines: list[str], first: int = 0) -> Iterator[tuple[int, str]]:
    """Number and text of the lines that hold more than a comment, after the first few."""
    for number, line in enumerate(lines[first:], start=first + 1):
        if not is_comment(line):
            yield number, line


def counts(source: Source, line: int, words: list[str], *, without_variables: bool = False) -> tuple[int, int]:
    """The numbers of variables and of entries in a header; clauses alone may be without variables."""
    n, n_entries = map(int, words) if all(map(is_count, words)) else (-1, 0)
    if not (n_entries > 0 and not without_variables) <= n <= MOST_VARIABLES:
        expected = f"a number of variables from 1 to {MOST_VARIABLES} and a number of entries"
        raise source.fault(quoted(" ".join(words)), expected, line)
    return n, n_entries


def is_count(word: str) -> bool:
    """Whether a word is an integer >= 0 that Python reads at once."""
    return word.isascii() and word.isdecimal() and len(word) <= 100


def quoted(text: str) -> str:
    """What was found, short enough for a line."""
    text = " ".join(text.split())
    return repr(text if len(text) <= 60 else f"{text[:57]}...")
