"""Second readers of the formats, slow and plain: no array, no clever case, numbers as fractions.

Each refuses with ``RefusedError`` what its format does not have, and with ``UnsureError`` where a file could be
meant in several ways and this reader does not decide.
"""

import ast
import csv
import io
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from typing import NamedTuple

Bits = Sequence[int]


class RefusedError(Exception):
    """The file is not of the format."""


class UnsureError(Exception):
    """This reader does not know what the file means."""


class Meaning(NamedTuple):
    """What a problem file means: its variables, and what a state of all of them counts."""

    n: int
    score: Callable[[Bits], tuple[Fraction, int]]


# ------------------------------------------------------------------------------------------------ problem files

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


def _text(data: bytes) -> list[str]:
    if 0 in data[:4096]:
        raise RefusedError("binary")
    if data.startswith(b"\xef\xbb\xbf"):
        data = data[3:]
    text = "".join(chr(byte) if byte < 128 and not 28 <= byte < 32 else "\ufffd" for byte in data)
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if not "".join(lines).strip():
        raise RefusedError("empty")
    return lines


def _is_comment(line: str) -> bool:
    words = line.split()
    return not words or words[0].startswith(("#", "%", "//")) or words[0] in ("c", "C")


def _rows(lines: list[str]) -> Iterator[list[str]]:
    for line in lines:
        if not _is_comment(line):
            yield line.split("#")[0].split()


def _number(word: str) -> Fraction:
    if not _NUMBER.fullmatch(word) or len(word) > 1000:
        raise RefusedError(word)
    if abs(float(word)) == float("inf"):
        raise RefusedError(word)
    mantissa = re.split("[eE]", word)[0]
    if not re.search("[1-9]", mantissa):
        return Fraction(0)
    if float(word) == 0:
        raise RefusedError(word)
    return Fraction(word)


def _count(word: str) -> int:
    if not re.fullmatch("[0-9]{1,100}", word):
        raise RefusedError(word)
    return int(word)


def _index(word: str, low: int, high: int) -> int:
    """An index; 1.0 and 1e0 are whole numbers, too."""
    value = _number(word)
    if value.denominator != 1 or not low <= value <= high:
        raise RefusedError(word)
    return int(value)


def _sized(word: str, most: int = 10**7) -> int:
    n = _count(word)
    if n > most:
        raise RefusedError(word)
    return n


Entry = tuple[int, int, Fraction]


def _entries(rows: list[list[str]], low: int, high: int, widths: tuple[int, ...]) -> list[Entry]:
    if rows and (len(rows[0]) not in widths or any(len(row) != len(rows[0]) for row in rows)):
        raise RefusedError("width")
    found = []
    for row in rows:
        weight = _number(row[2]) if len(row) > 2 else Fraction(1)
        found.append((_index(row[0], low, high), _index(row[1], low, high), weight))
    return found


def _counted(rows: list[list[str]]) -> tuple[int, int, list[list[str]]]:
    """A header of two numbers, and the rows below it."""
    if not rows or len(rows[0]) < 2:
        raise RefusedError("header")
    n, m = _sized(rows[0][0]), _count(rows[0][1])
    if (n == 0 and m > 0) or len(rows) - 1 != m:
        raise RefusedError("number of entries")
    return n, m, rows[1:]


def gset(data: bytes) -> Meaning:
    """Cut weight."""
    n, _, rows = _counted(list(_rows(_text(data))))
    edges = _entries(rows, 1, max(n, 1), (3, 2))
    return Meaning(n, lambda x: (sum((w for i, j, w in edges if x[i - 1] != x[j - 1]), Fraction()), 0))


def beasley(data: bytes) -> Meaning:
    """x'Qx of the upper triangle."""
    n, _, rows = _counted(list(_rows(_text(data))))
    entries = _entries(rows, 1, max(n, 1), (3,))
    if any(i > j for i, j, _ in entries):
        raise RefusedError("lower triangle")

    def score(x: Bits) -> tuple[Fraction, int]:
        return sum(((1 if i == j else 2) * q * x[i - 1] * x[j - 1] for i, j, q in entries), Fraction()), 0

    return Meaning(n, score)


def _said(lines: list[str]) -> tuple[str | None, Fraction]:
    """Kind of variables and constant, where comments say them in the plainest way alone."""
    kind, constant = None, Fraction()
    for line in lines:
        said = line if _is_comment(line) else line.partition("#")[2]
        said = said.strip().lstrip("#%cC/ ").strip()
        if not re.search("vartype|var.type|offset|constant|spin|ising", said, re.IGNORECASE):
            continue
        if match := re.fullmatch(r"vartype=(SPIN|BINARY)", said):
            if kind not in (None, match[1]):
                raise RefusedError("two kinds")
            kind = match[1]
        elif match := re.fullmatch(r"offset=(\S+)", said):
            if constant:
                raise UnsureError("two constants")
            constant = _number(match[1])
        else:
            raise UnsureError(said)
    return kind, constant


def coo(data: bytes) -> Meaning:
    """i j bias from 0, of bits or spins."""
    lines = _text(data)
    kind, constant = _said(lines)
    entries = _entries(list(_rows(lines)), 0, 10**7 - 1, (3,))
    if not entries and kind is None:
        raise RefusedError("nothing")
    n = 1 + max((max(i, j) for i, j, _ in entries), default=-1)

    def score(x: Bits) -> tuple[Fraction, int]:
        of = [2 * bit - 1 for bit in x] if kind == "SPIN" else x
        return constant + sum((q * (of[i] if i == j else of[i] * of[j]) for i, j, q in entries), Fraction()), 0

    return Meaning(n, score)


def qbsolv(data: bytes) -> Meaning:
    """p qubo: the sum of q x_i x_j."""
    lines = _text(data)
    rows = list(_rows(lines))
    if not rows or rows[0][:2] != ["p", "qubo"] or len(rows[0]) != 6:
        raise RefusedError("header")
    n, n_nodes, n_couplers = _sized(rows[0][3]), _count(rows[0][4]), _count(rows[0][5])
    if n == 0 and (n_nodes > 0 or len(rows) > 1):
        raise RefusedError("no variables")
    entries = _entries(rows[1:], 0, n - 1, (3,))
    own = sum(i == j for i, j, _ in entries)
    if (own, len(entries) - own) != (n_nodes, n_couplers):
        raise RefusedError("numbers of entries")
    _, constant = _said(lines)
    return Meaning(n, lambda x: (constant + sum((q * x[i] * x[j] for i, j, q in entries), Fraction()), 0))


def mtx(data: bytes) -> Meaning:
    """x'Qx of a whole matrix."""
    lines = _text(data)
    words = lines[0].lower().split()
    if len(words) != 5 or words[:2] != ["%%matrixmarket", "matrix"]:
        raise RefusedError("banner")
    layout, field, symmetry = words[2:]
    if (
        layout not in ("coordinate", "array")
        or field not in ("integer", "real", "pattern")
        or symmetry not in ("general", "symmetric")
    ):
        raise RefusedError("kind")
    rows = list(_rows(lines[1:]))
    if not rows or len(rows[0]) != (3 if layout == "coordinate" else 2) or rows[0][0] != rows[0][1]:
        raise RefusedError("size")
    n, given = _sized(rows[0][0]), _count(rows[0][-1])
    if n == 0 and given > 0:
        raise RefusedError("size")
    symmetric = symmetry == "symmetric"
    if layout == "coordinate":
        entries = _entries(rows[1:], 1, max(n, 1), (2,) if field == "pattern" else (3,))
        if len(entries) != given:
            raise RefusedError("entries")
    else:
        places = [(i, j) for j in range(1, n + 1) for i in range(j if symmetric else 1, n + 1)]
        if field == "pattern" or len(rows) - 1 != len(places) or any(len(row) != 1 for row in rows[1:]):
            raise RefusedError("entries")
        entries = [(i, j, _number(row[0])) for (i, j), row in zip(places, rows[1:], strict=True)]
    if symmetric and any(i < j for i, j, _ in entries):
        raise RefusedError("upper triangle")

    def score(x: Bits) -> tuple[Fraction, int]:
        total = Fraction()
        for i, j, q in entries:
            total += q * x[i - 1] * x[j - 1]
            if symmetric and i != j:
                total += q * x[j - 1] * x[i - 1]
        return total, 0

    return Meaning(n, score)


def _clauses(lines: list[str]) -> Iterator[list[str]]:
    for line in lines:
        words = line.split()
        if words and words[0] == "%":
            return
        if words and words[0][0] not in "c#":
            yield words


def _literal(word: str, n: int) -> int:
    if not re.fullmatch("[+-]?[0-9]{1,18}", word) or abs(int(word)) > n:
        raise RefusedError(word)
    return int(word)


def _is_true(clause: list[int], x: Bits) -> bool:
    return any(x[abs(literal) - 1] == (literal > 0) for literal in clause)


def cnf(data: bytes) -> Meaning:
    """Number of unsatisfied clauses."""
    rows = list(_clauses(_text(data)))
    if not rows or rows[0][:2] != ["p", "cnf"] or len(rows[0]) != 4:
        raise RefusedError("header")
    n, m = _sized(rows[0][2]), _count(rows[0][3])
    clauses, clause = list[list[int]](), list[int]()
    for row in rows[1:]:
        for word in row:
            if (literal := _literal(word, n)) == 0:
                clauses.append(clause)
                clause = []
            else:
                clause.append(literal)
    if clause or len(clauses) != m:
        raise RefusedError("number of clauses")
    return Meaning(n, lambda x: (Fraction(sum(not _is_true(c, x) for c in clauses)), 0))


def wcnf(data: bytes) -> Meaning:
    """Weight of unsatisfied soft clauses, number of unsatisfied hard ones."""
    rows = list(_clauses(_text(data)))
    n, m, top, old = 10**7, None, None, bool(rows) and rows[0][0] == "p"
    if old:
        if rows[0][1:2] != ["wcnf"] or len(rows[0]) not in (4, 5):
            raise RefusedError("header")
        n, m = _sized(rows[0][2]), _count(rows[0][3])
        top = _number(rows[0][4]) if len(rows[0]) == 5 else None
        if top is not None and top <= 0:
            raise RefusedError("top")
        rows = rows[1:]
    soft, hard = list[tuple[Fraction, list[int]]](), list[list[int]]()
    for first, *words in rows:
        weight = None if first == "h" and not old else _number(first)
        if weight is not None and weight < 0:
            raise RefusedError("weight")
        literals = [_literal(word, n) for word in words]
        if not literals or literals[-1] != 0 or 0 in literals[:-1]:
            raise RefusedError("clause")
        if weight is None or (top is not None and weight >= top):
            hard.append(literals[:-1])
        else:
            soft.append((weight, literals[:-1]))
    if m is not None and len(soft) + len(hard) != m:
        raise RefusedError("number of clauses")
    if m is None:
        n = max((abs(literal) for clause in [*hard, *(c for _, c in soft)] for literal in clause), default=0)

    def score(x: Bits) -> tuple[Fraction, int]:
        weight = sum((w for w, clause in soft if not _is_true(clause, x)), Fraction())
        return weight, sum(not _is_true(clause, x) for clause in hard)

    return Meaning(n, score)


PROBLEMS: dict[str, Callable[[bytes], Meaning]] = {
    "gset": gset,
    "beasley": beasley,
    "coo": coo,
    "qbsolv": qbsolv,
    "mtx": mtx,
    "cnf": cnf,
    "wcnf": wcnf,
}
"""By format."""


# ----------------------------------------------------------------------------------------------- tables, arrays

MISSING = ("", "NA", "N/A", "NaN", "nan", "null", "NULL", "None", "?")


def table(data: bytes, delimiter: str = ",") -> tuple[list[str], list[list[str | None]]]:
    """Names and rows of a CSV file with a header; None is an empty cell, truth values are in small letters."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RefusedError("text") from error
    if '"' in text and "\n" in "".join(text.split('"')[1::2]):
        raise UnsureError("a line break in a cell")
    lines = [line for line in csv.reader(io.StringIO(text, newline=""), delimiter=delimiter) if line]
    if not lines:
        raise RefusedError("empty")
    names = [name.strip() for name in lines[0]]
    if any(len(line) != len(names) for line in lines):
        raise RefusedError("cells")
    return names, [[_cell(cell) for cell in line] for line in lines[1:]]


def _cell(text: str) -> str | None:
    text = text.strip()
    if text in MISSING:
        return None
    return text.lower() if text.lower() in ("true", "false") else text


def fasta(data: bytes) -> list[tuple[str, str]]:
    """Names and sequences."""
    found: list[tuple[str, str]] = []
    for line in data.decode("utf-8-sig", "replace").replace("\r\n", "\n").replace("\r", "\n").split("\n"):
        if line.startswith(">"):
            words = line[1:].lstrip(">").split()
            found.append((words[0] if words else str(len(found) + 1), ""))
        elif found:
            found[-1] = (found[-1][0], found[-1][1] + "".join(line.split()))
        elif line.strip():
            raise RefusedError("no header")
    if not found or not all(sequence for _, sequence in found):
        raise RefusedError("no sequence")
    return found


def npy(data: bytes) -> tuple[tuple[int, ...], list[float]]:
    """Shape and numbers of an array, row by row."""
    if data[:6] != b"\x93NUMPY" or len(data) < 10:
        raise RefusedError("begin")
    wide = data[6] >= 2
    begin = 12 if wide else 10
    (length,) = struct.unpack("<I" if wide else "<H", data[8:begin])
    try:
        header = ast.literal_eval(data[begin : begin + length].decode("latin1"))
        order, kind, size = re.findall(r"\A([<>|])([biuf])(\d)\Z", header["descr"])[0]
        shape, in_columns = tuple(header["shape"]), header["fortran_order"]
    except Exception as error:
        raise RefusedError("header") from error
    signs = {"b1": "?", "i1": "b", "i2": "h", "i4": "i", "i8": "q", "u1": "B", "u2": "H", "u4": "I", "u8": "Q"}
    signs |= {"f2": "e", "f4": "f", "f8": "d"}
    n = 1
    for axis in shape:
        n *= axis
    body = data[begin + length : begin + length + n * int(size)]
    if len(body) < n * int(size) or kind + size not in signs:
        raise RefusedError("bytes")
    flat = struct.unpack(f"{'>' if order == '>' else '<'}{n}{signs[kind + size]}", body)
    if in_columns and len(shape) == 2:
        flat = tuple(flat[j * shape[0] + i] for i in range(shape[0]) for j in range(shape[1]))
    return shape, [float(x) for x in flat]


def idx(data: bytes) -> tuple[tuple[int, ...], list[int]]:
    """Shape and bytes of a file of MNIST."""
    if len(data) < 4 or data[:3] != b"\0\0\x08":
        raise RefusedError("magic number")
    n_axes = data[3]
    shape = tuple(int.from_bytes(data[4 + 4 * k : 8 + 4 * k], "big") for k in range(n_axes))
    n = 1
    for axis in shape:
        n *= axis
    if len(data) != 4 + 4 * n_axes + n:
        raise RefusedError("bytes")
    return shape, list(data[4 + 4 * n_axes :])
