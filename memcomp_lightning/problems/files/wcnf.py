"""DIMACS WCNF, one clause a line: from before 2022 (``p wcnf n m top``) or since (no header, ``h``)."""

from itertools import chain

from memcomp_lightning.problems.files.comments import unread
from memcomp_lightning.problems.files.dimacs import literals, rows
from memcomp_lightning.problems.files.numbers import Exact, fits, number
from memcomp_lightning.problems.files.objective import Parsed, from_clauses
from memcomp_lightning.problems.files.source import Source, counts, quoted

_WEIGHT = "a weight >= 0"


def parse(source: Source, maximise: bool) -> Parsed:
    """Weighted MAX-SAT; clauses that weigh top or more are hard."""
    lines = source.lines()
    listed = rows(lines)
    n: int | None = None
    m: int | None = None
    top: Exact | None = None
    line, header = next(listed, (0, []))
    old = header[:1] == ["p"]
    if old:
        if header[1:2] != ["wcnf"] or len(header) not in (4, 5):
            expected = "'p wcnf n m top', or no such line; unweighted clauses are format=cnf"
            raise source.fault(quoted(" ".join(header)), expected, line)
        n, m = counts(source, line, header[2:4], without_variables=True)
        if len(header) == 5:
            top = _weight(source, line, header[4], "a number for top")
            if top == 0:
                raise source.fault("top 0", "a number > 0: clauses that weigh as much or more are hard", line)
    elif line:
        listed = chain([(line, header)], listed)
    clauses: list[list[int]] = []
    weights: list[Exact] = []
    hard: list[bool] = []
    for at, (first, *words) in listed:
        weight = None if first == "h" and not old else _weight(source, at, first, _WEIGHT if old else _OR_HARD)
        found = literals(source, at, words, n)
        if not found or found[-1] != 0:
            raise source.fault("a clause without its closing 0", "a 0 at the end of the line", at)
        if 0 in found[:-1]:
            raise source.fault("a 0 inside a clause", "one clause a line", at)
        clauses.append(found[:-1])
        hard.append(weight is None or (top is not None and weight >= top))
        weights.append(0 if weight is None or hard[-1] else weight)
    if m is not None and len(clauses) != m:
        raise source.fault(f"{len(clauses)} clauses", f"m = {m} of line {line}")
    remarks = unread(lines)
    if n is None:
        n = max((abs(literal) for clause in clauses for literal in clause), default=0)
    if not clauses:
        remarks.append("There are no clauses: an empty formula is satisfied.")
    return from_clauses(source, "weight of unsatisfied soft clauses", n, clauses, weights, hard, remarks)


_OR_HARD = f"{_WEIGHT}, or h for a hard clause"


def _weight(source: Source, line: int, word: str, expected: str) -> Exact:
    if not fits(word) or (value := number(word)) < 0:
        raise source.fault(quoted(word), expected, line)
    return value
