"""File formats of benchmark problems: what stands in a file, as a problem to minimise.

Couplings are read by numpy in one go, clauses line by line. Every fault is named by file, line, what was found and
what was expected. Numbers become float64.
"""

import io
import math
import re
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.qubo.from_model import from_model
from memcomp_lightning.qubo.maxsat import WeightedMaxSat
from memcomp_lightning.qubo.qubo import Qubo


class ProblemFileError(ValueError):
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
        lines = self.data.removeprefix(b"\xef\xbb\xbf").decode("ascii", "replace").splitlines()
        if not any(line and not line.isspace() for line in lines):
            raise self.fault("an empty file", "a problem")
        return lines


@dataclass(frozen=True, slots=True, eq=False)
class ClauseList:
    """Clauses as the file lists them, to count in its own terms.

    Attributes:
        literals: ``(n_literals,)`` int64 as in DIMACS, all clauses after one another.
        clause: ``(n_literals,)`` int64, the clause that a literal belongs to.
        weight: ``(n_clauses,)`` float64, as in the file; of hard clauses 0.
        hard: ``(n_clauses,)`` bool.
    """

    literals: Tensor
    clause: Tensor
    weight: Tensor
    hard: Tensor

    def unsatisfied(self, x: Tensor) -> Tensor:
        """Which clauses have no true literal in the state ``x (n,)``: ``(n_clauses,)`` bool."""
        true = (x[self.literals.abs() - 1] > 0.5) == (self.literals > 0)
        return torch.zeros(self.hard.shape, dtype=torch.int64).index_add_(0, self.clause, true.long()) == 0


@dataclass(frozen=True, slots=True, eq=False)
class Objective:
    """What the authors of a file count, and which way.

    Attributes:
        name: Such as "cut weight".
        maximised: Whether more is better; the energy of the problem always falls.
        clauses: The clauses of a MAX-SAT file.
    """

    name: str
    maximised: bool = False
    clauses: ClauseList | None = None

    @property
    def direction(self) -> str:
        """``"maximise"`` or ``"minimise"``."""
        return "maximise" if self.maximised else "minimise"


Parsed = tuple[Qubo | WeightedMaxSat, Objective]

MOST_VARIABLES = 10**7
"""A larger number of variables is taken for a misprint: their list alone would fill the memory."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_HEADER = re.compile(r"\s*(\d+)\s+(\d+)(\s|$)")
_VARTYPE = re.compile(r"\s*#.*?vartype[:=]\s*(\w+)")


def _gset(source: Source, maximise: bool) -> Parsed:
    """MAX-CUT: n vertices and m edges, then ``i j w``. The energy is -cut = sum of w (2 x_i x_j - x_i - x_j)."""
    table = _Table.with_header(source, "vertices", "edges", columns=(3, 2))
    i, j, w = table.pairs(1, table.n, "vertices")
    table.check(table.values[:, 0] != table.values[:, 1], "two different vertices")
    qubo = Qubo.from_coo(table.n, torch.cat((i, i, j)), torch.cat((j, i, j)), torch.cat((2 * w, -w, -w)))
    return qubo, Objective("cut weight", maximised=True)


def _beasley(source: Source, maximise: bool) -> Parsed:
    """``x'Qx`` with Q symmetric and listed where i <= j: an off-diagonal entry counts twice."""
    table = _Table.with_header(source, "variables", "entries", columns=(3,))
    i, j, q = table.pairs(1, table.n, "variables")
    table.check(table.values[:, 0] <= table.values[:, 1], "i <= j, the upper triangle of a symmetric matrix")
    sign = -1.0 if maximise else 1.0
    return Qubo.from_coo(table.n, i, j, sign * torch.where(i == j, q, 2 * q)), Objective("x'Qx", maximise)


def _coo(source: Source, maximise: bool) -> Parsed:
    """The coordinate list of dimod: ``i j bias`` from 0, i = j is linear, x in {0, 1} or s = 2 x - 1 in {-1, 1}.

    dimod leaves out the constant of a model. Spins give one of their own when s becomes x: with it the energy is
    that of the file for every state.
    """
    lines = source.lines()
    vartype = "BINARY"
    for number, line in enumerate(lines, start=1):
        if "#" in line and (header := _VARTYPE.match(line)):
            vartype = header[1]
            if vartype not in ("BINARY", "SPIN"):
                raise source.fault(f"vartype {vartype}", "BINARY or SPIN", number)
    table = _Table.read(source, lines, 0, (3,))
    i, j, bias = table.pairs(0, MOST_VARIABLES - 1, "variables")
    if not len(bias):
        raise source.fault("no entries", "lines 'i j bias'")
    n = 1 + int(torch.maximum(i, j).max())
    bias = -bias if maximise else bias
    objective = Objective(f"{vartype} energy", maximise)
    if vartype == "BINARY":
        return Qubo.from_coo(n, i, j, bias), objective
    (a, b, coupling), (k, linear) = (t[i != j] for t in (i, j, bias)), (t[i == j] for t in (i, bias))
    return Qubo.from_coo(
        n,
        torch.cat((a, a, b, k)),
        torch.cat((b, a, b, k)),
        torch.cat((4 * coupling, -2 * coupling, -2 * coupling, 2 * linear)),
        offset=coupling.sum() - linear.sum(),
    ), objective


def _cnf(source: Source, maximise: bool) -> Parsed:
    """DIMACS CNF, every clause of weight 1. A clause ends at its 0, on whatever line that is."""
    rows = _dimacs_rows(source)
    line, header = next(rows)
    if header[:2] != ["p", "cnf"] or len(header) != 4:
        raise source.fault(_quoted(" ".join(header)), "'p cnf n m'; weighted clauses are format=wcnf", line)
    n, m = _counts(source, line, header[2:])
    clauses: list[list[int]] = []
    pending: list[int] = []
    begin = first_open = 0
    for number, tokens in rows:
        literals = _literals(source, number, tokens, n)
        first_open = first_open or (number if literals[-1] else 0)
        for literal in literals:
            if literal:
                begin = begin if pending else number
                pending.append(literal)
            else:
                clauses.append(pending)
                pending = []
    if pending:
        raise source.fault("a clause without its closing 0", "a 0 after its last literal", begin)
    if len(clauses) != m:
        hint = f" (line {first_open} does not end in 0)" if first_open else ""
        raise source.fault(f"{len(clauses)} clauses", f"m = {m} of line {line}{hint}")
    return _maxsat(n, clauses, [1.0] * m, [False] * m, "unsatisfied clauses")


def _wcnf(source: Source, maximise: bool) -> Parsed:
    """DIMACS WCNF with one clause a line, from before 2022 (``p wcnf n m top``) or since (no header, ``h``)."""
    rows = _dimacs_rows(source)
    n: int | None = None
    m: int | None = None
    top: float | None = None
    line, header = next(rows)
    if header[0] == "p":
        if header[1:2] != ["wcnf"] or len(header) not in (4, 5):
            expected = "'p wcnf n m top', or no such line; unweighted clauses are format=cnf"
            raise source.fault(_quoted(" ".join(header)), expected, line)
        n, m = _counts(source, line, header[2:4])
        top = _weight(source, line, header[4], "a number for top") if len(header) == 5 else math.inf
    else:
        rows = chain([(line, header)], rows)
    clauses: list[list[int]] = []
    weights: list[float] = []
    hard: list[bool] = []
    for number, (first, *tokens) in rows:
        is_hard = first == "h" and top is None
        weight = 0.0 if is_hard else _weight(source, number, first, _WEIGHT if top is None else "a weight >= 0")
        literals = _literals(source, number, tokens, n)
        if not literals or literals[-1] != 0:
            raise source.fault("a clause without its closing 0", "a 0 at the end of the line", number)
        if 0 in literals[:-1]:
            raise source.fault("a 0 inside a clause", "one clause a line", number)
        clauses.append(literals[:-1])
        hard.append(is_hard or (top is not None and weight >= top))
        weights.append(0.0 if hard[-1] else weight)
    if m is not None and len(clauses) != m:
        raise source.fault(f"{len(clauses)} clauses", f"m = {m} of line {line}")
    if n is None:
        n = max((abs(literal) for clause in clauses for literal in clause), default=0)
        if n == 0:
            raise source.fault("no variables", "clauses with literals")
    return _maxsat(n, clauses, weights, hard, "weight of unsatisfied soft clauses")


def _rbm(source: Source, maximise: bool) -> Parsed:
    """An RBM as arrays ``weight (n_hidden, n_visible)``, ``b (n_visible,)`` and ``c (n_hidden,)``; x = (v, h)."""
    try:
        with np.load(io.BytesIO(source.data), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in ("weight", "b", "c") if name in archive.files}
            names = ", ".join(map(repr, archive.files)) or "no arrays"
    except (OSError, ValueError, EOFError, AttributeError, TypeError, zipfile.BadZipFile, zlib.error) as error:
        cause = str(error).partition("\n")[0]
        raise source.fault(f"no readable arrays ({cause})", "an .npz archive of numpy.savez") from error
    if len(arrays) < 3:
        raise source.fault(names, "the arrays 'weight', 'b' and 'c'")
    for name, array in arrays.items():
        if array.dtype.kind not in "fiub" or not np.isfinite(array).all():
            raise source.fault(f"{name} of type {array.dtype} with entries that are not", "finite numbers")
    weight, b, c = (arrays[name] for name in ("weight", "b", "c"))
    if weight.ndim != 2 or 0 in weight.shape:
        raise source.fault(f"weight of shape {weight.shape}", "(n_hidden, n_visible), both >= 1")
    for name, array, size in (("b", b, weight.shape[1]), ("c", c, weight.shape[0])):
        if array.shape != (size,):
            raise source.fault(f"{name} of shape {array.shape}", f"({size},), as weight is {weight.shape}")
    rbm = RBM(n_visible=len(b), n_hidden=len(c)).double()
    rbm.load_state_dict({name: torch.from_numpy(array.astype(np.float64)) for name, array in arrays.items()})
    return from_model(rbm), Objective("E(v, h)")


class Format(NamedTuple):
    """One file format.

    Attributes:
        parse: From the file, and whether its objective is to be maximised, to a problem to minimise.
        suffixes: File names that tell it.
        layout: For a person.
        either_way: Whether the authors of such files minimise or maximise, as they like.
    """

    parse: Callable[[Source, bool], Parsed]
    suffixes: tuple[str, ...]
    layout: str
    either_way: bool = False


FORMATS = {
    "gset": Format(_gset, (".gset", ".mc", ".rud"), "G-set MAX-CUT: 'n m', then 'i j w' from 1"),
    "beasley": Format(_beasley, (".sparse",), "Beasley's x'Qx: 'n nnz', then 'i j q' from 1, i <= j", True),
    "coo": Format(_coo, (".coo",), "dimod's 'i j bias' from 0, '# vartype=SPIN' or BINARY before", True),
    "wcnf": Format(_wcnf, (".wcnf",), "weighted MAX-SAT, 'p wcnf n m top' or the form of 2022 with 'h'"),
    "cnf": Format(_cnf, (".cnf",), "MAX-SAT, 'p cnf n m'"),
    "rbm": Format(_rbm, (".npz",), "numpy arrays weight (n_hidden, n_visible), b, c"),
}
"""By name. A ``.gz`` may follow every suffix; ``.txt`` and no suffix are told by the first lines."""


def guess(lines: list[str]) -> str | None:
    """The format of a text by its first lines, None if they do not tell it.

    >>> guess(["3 2", "1 2 1", "2 3 1"]), guess(["0 0 1.5", "0 1 -1"]), guess(["c a comment", "h 1 2 0"])
    ('gset', 'coo', 'wcnf')
    """
    rows = [words for words in map(str.split, lines[:1000]) if words]
    words = next((words for words in rows if words[0][0] != "c"), [""])
    if words[0] == "p":
        return words[1] if words[1:2] in (["cnf"], ["wcnf"]) else None
    if words[0] == "h" or rows[0][0][0] == "c":
        return "wcnf"
    if words[0][0] == "#" or (len(words) == 3 and all(map(_NUMBER.fullmatch, words))):
        return "coo"
    return "gset" if _HEADER.match(" ".join(words)) else None


@dataclass(frozen=True, slots=True, eq=False)
class _Table:
    """Lines of two or three numbers.

    Attributes:
        source: The file.
        lines: All of its lines.
        first: How many of them come before the table.
        values: ``(n_rows, 3)``; a third number that is left out is 1.
        n: The first number of the header.
    """

    source: Source
    lines: list[str]
    first: int
    values: NDArray[np.float64]
    n: int = 0

    @staticmethod
    def with_header(source: Source, variables: str, entries: str, columns: tuple[int, ...]) -> "_Table":
        """A table after a line with the numbers of variables and entries, and perhaps words."""
        lines = source.lines()
        at, header = next(_filled(lines, 0), (1, lines[0]))
        match = _HEADER.match(header)
        if match is None:
            expected = f"the numbers of {variables} and {entries}"
            raise source.fault(_quoted(header), expected, at)
        n, n_entries = _counts(source, at, [match[1], match[2]])
        table = _Table.read(source, lines, at, columns)
        if len(table.values) != n_entries:
            raise source.fault(f"{len(table.values)} {entries}", f"{n_entries}, the second number of line {at}")
        return _Table(source, lines, at, table.values, n)

    @staticmethod
    def read(source: Source, lines: list[str], first: int, columns: tuple[int, ...]) -> "_Table":
        """All rows after the first few lines; ``columns`` are the numbers of columns that the format allows."""
        top = next((line.partition("#")[0].split() for _, line in _filled(lines, first)), None)
        if top is None:
            return _Table(source, lines, first, np.zeros((0, 3)))
        width = len(top) if len(top) in columns else columns[0]
        try:
            values = np.loadtxt(lines[first:], ndmin=2, comments="#")
        except ValueError as error:
            for number, line in _filled(lines, first):
                fields = line.partition("#")[0].split()
                if len(fields) != width or not all(map(_NUMBER.fullmatch, fields)):
                    raise source.fault(_quoted(line), f"{width} numbers", number) from error
            raise source.fault(f"something else ({error})", f"lines of {width} numbers") from error
        table = _Table(source, lines, first, values)
        table.check(np.full(len(values), values.shape[1] == width), f"{width} numbers")
        table.check(np.isfinite(values).min(1), "finite numbers")
        return _Table(source, lines, first, values if width == 3 else np.insert(values, 2, 1.0, axis=1))

    def check(self, good: NDArray[np.bool_], expected: str) -> None:
        """Raise at the first row that is not good."""
        if not np.all(good):
            row = int(np.argmin(good))
            number, line = next(entry for k, entry in enumerate(_filled(self.lines, self.first)) if k == row)
            raise self.source.fault(_quoted(line), expected, number)

    def pairs(self, low: int, high: int, kind: str) -> tuple[Tensor, Tensor, Tensor]:
        """Row and column counted from 0, and value; ``low`` and ``high`` bound what the file may say."""
        index = self.values[:, :2]
        good = ((index >= low) & (index <= high) & (index == np.floor(index))).min(1)
        self.check(good, f"two {kind}, integers from {low} to {high}")
        i, j = torch.from_numpy(index.astype(np.int64) - low).unbind(-1)
        return i, j, torch.from_numpy(self.values[:, 2].copy())


def _filled(lines: list[str], first: int) -> Iterator[tuple[int, str]]:
    """Number and text of the lines that hold more than a comment, after the first few."""
    for number, line in enumerate(lines[first:], start=first + 1):
        if line.partition("#")[0].strip():
            yield number, line


def _dimacs_rows(source: Source) -> Iterator[tuple[int, list[str]]]:
    """Line number and words of what is no comment; the % of SATLIB's files ends them."""
    empty = True
    for number, line in enumerate(source.lines(), start=1):
        words = line.split()
        if words and words[0] == "%":
            break
        if words and words[0][0] != "c":
            empty = False
            yield number, words
    if empty:
        raise source.fault("nothing but comments", "clauses")


def _counts(source: Source, line: int, words: list[str]) -> tuple[int, int]:
    """The numbers of variables and of entries in a header."""
    if not all(map(str.isdecimal, words)) or not 1 <= int(words[0]) <= MOST_VARIABLES:
        expected = f"a number of variables from 1 to {MOST_VARIABLES} and a number of entries"
        raise source.fault(_quoted(" ".join(words)), expected, line)
    return int(words[0]), int(words[1])


_WEIGHT = "a weight >= 0, or h for a hard clause"


def _weight(source: Source, line: int, word: str, expected: str) -> float:
    weight = float(word) if _NUMBER.fullmatch(word) else math.nan
    if not 0 <= weight < math.inf:
        raise source.fault(_quoted(word), expected, line)
    return weight


def _literals(source: Source, line: int, words: list[str], n: int | None) -> list[int]:
    """Literals and zeros of a line; ``n`` is the largest variable, None if the file does not say it."""
    limit = MOST_VARIABLES if n is None else n
    try:
        literals = list(map(int, words))
    except ValueError as error:
        raise source.fault(_quoted(" ".join(words)), "literals, integers that end in 0", line) from error
    for literal in literals:
        if abs(literal) > limit:
            raise source.fault(f"literal {literal}", f"variables from 1 to {limit}", line)
    return literals


def _maxsat(n: int, clauses: list[list[int]], weights: list[float], hard: list[bool], name: str) -> Parsed:
    """Hard clauses weigh more than all soft ones together: breaking one never pays."""
    lengths = torch.tensor([len(clause) for clause in clauses], dtype=torch.int64)
    listed = ClauseList(
        literals=torch.tensor([literal for clause in clauses for literal in clause], dtype=torch.int64),
        clause=torch.arange(len(clauses)).repeat_interleave(lengths),
        weight=torch.tensor(weights, dtype=torch.float64),
        hard=torch.tensor(hard, dtype=torch.bool),
    )
    above = 1 + math.fsum(weights)
    energies = [above if is_hard else weight for weight, is_hard in zip(weights, hard, strict=True)]
    return WeightedMaxSat.from_clauses(n, clauses, energies), Objective(name, clauses=listed)


def _quoted(text: str) -> str:
    """What was found, short enough for a line."""
    text = " ".join(text.split())
    return repr(text if len(text) <= 60 else f"{text[:57]}...")
