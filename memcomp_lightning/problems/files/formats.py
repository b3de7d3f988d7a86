"""The table of file formats, and which of them a text is."""

from collections.abc import Callable
from itertools import islice
from typing import NamedTuple

from memcomp_lightning.problems.files import beasley, cnf, coo, gset, matrix_market, qbsolv, rbm, wcnf
from memcomp_lightning.problems.files.numbers import NUMBER
from memcomp_lightning.problems.files.objective import Parsed
from memcomp_lightning.problems.files.source import Source, filled, quoted
from memcomp_lightning.problems.files.table import HEADER


class Format(NamedTuple):
    """One file format.

    Attributes:
        parse: From the file, and whether its objective is to be maximised, to a problem to minimise.
        suffixes: Suffixes of such files.
        layout: What such a file looks like, for messages.
        either_way: Whether some files of this format are to be minimised and others to be maximised.
    """

    parse: Callable[[Source, bool], Parsed]
    suffixes: tuple[str, ...]
    layout: str
    either_way: bool = False


FORMATS = {
    "gset": Format(gset.parse, (".gset", ".mc", ".rud"), "G-set MAX-CUT: 'n m', then 'i j w' from 1"),
    "beasley": Format(beasley.parse, (".sparse",), "Beasley's x'Qx: 'n nnz', then 'i j q' from 1, i <= j", True),
    "coo": Format(coo.parse, (".coo",), "dimod's 'i j bias' from 0, '# vartype=SPIN' or BINARY before", True),
    "qbsolv": Format(qbsolv.parse, (".qubo",), "qbsolv's 'p qubo 0 n nodes couplers', then 'i j q' from 0", True),
    "mtx": Format(matrix_market.parse, (".mtx",), "Matrix Market, a square matrix Q of x'Qx", True),
    "wcnf": Format(wcnf.parse, (".wcnf",), "weighted MAX-SAT, 'p wcnf n m top' or the form of 2022 with 'h'"),
    "cnf": Format(cnf.parse, (".cnf",), "MAX-SAT, 'p cnf n m'"),
    "rbm": Format(rbm.parse, (".npz",), "numpy arrays weight (n_hidden, n_visible), b, c"),
}
"""By name. ``.gz``, ``.xz`` or ``.bz2`` may follow; ``.txt`` and no suffix are told by the first lines."""

_OF_P_LINE = {"cnf": "cnf", "wcnf": "wcnf", "qubo": "qbsolv"}


def guess(source: Source) -> str | None:
    r"""The format of a text by its lines, None if they do not tell it.

    Raises:
        ProblemFileError: The lines fit several formats, which give different problems.

    >>> def of(text): return guess(Source(None, text.encode()))
    >>> of("3 2\n1 2 1\n2 3 1"), of("0 0 1.5\n0 1 -1"), of("c a comment\nh 1 2 0")
    ('gset', 'coo', 'wcnf')
    """
    lines = source.lines()
    if lines[0].lower().startswith(matrix_market.BANNER.lower()):
        return "mtx"
    rows = [line.partition("#")[0].split() for _, line in islice(filled(lines), 1000)]
    if not rows:
        return None
    first = rows[0]
    if first[0] == "p":
        return _OF_P_LINE.get(first[1]) if len(first) > 1 else None
    if first[0] == "h":
        return "wcnf"
    begun_by_c = any(line.split()[0] == "c" for line in lines[: next(filled(lines))[0]] if line.strip())
    closed = all(row[-1] == "0" and all(map(NUMBER.fullmatch, row)) for row in rows if row[0] != "h")
    if closed and (begun_by_c or any(len(row) > 3 or row[0] == "h" for row in rows)):
        if len(rows) == 1 and len(first) == 2:
            raise _several(source, lines, "an empty clause or a graph without edges", ("wcnf", "gset"))
        if all(len(row) == 3 and row[0] != "h" for row in rows) and any("#" in line for line in lines):
            raise _several(source, lines, "a clause or an entry", ("wcnf", "coo"))
        return "wcnf"
    if len(first) == 3 and all(map(NUMBER.fullmatch, first)):
        if not any("vartype" in line.lower() for line in lines if "#" in line) and _may_be_header(lines, first):
            raise _several(source, lines, "a header with a third number or an entry", ("gset", "beasley", "coo"))
        return "coo"
    return "gset" if HEADER.match(" ".join(first)) else None


def _may_be_header(lines: list[str], first: list[str]) -> bool:
    """Whether three numbers may be a header: the second counts the lines that follow, or no index is 0."""
    rows = [line.partition("#")[0].split() for _, line in filled(lines)]
    from_zero = any("0" in row[:2] for row in rows)
    return not from_zero or (first[1] == str(len(rows) - 1) and first[0] != "0")


def _several(source: Source, lines: list[str], meanings: str, names: tuple[str, ...]) -> Exception:
    at, line = next(filled(lines))
    options = "; ".join(f"format={name} ({FORMATS[name].layout})" for name in names)
    return source.fault(f"{quoted(line)}, which may be {meanings}", f"you to say which: {options}", at)
