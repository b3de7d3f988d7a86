"""DIMACS CNF: ``p cnf n m``, then clauses that end in 0."""

from memcomp_lightning.problems.files.comments import unread
from memcomp_lightning.problems.files.dimacs import literals, rows
from memcomp_lightning.problems.files.numbers import Exact
from memcomp_lightning.problems.files.objective import Parsed, from_clauses
from memcomp_lightning.problems.files.source import Source, counts, quoted


def parse(source: Source, maximise: bool) -> Parsed:
    """MAX-SAT, every clause of weight 1. A clause ends at its 0, on whatever line that is."""
    lines = source.lines()
    listed = rows(lines)
    line, header = next(listed, (0, []))
    if not line:
        raise source.fault("nothing but comments", "clauses")
    if header[:2] != ["p", "cnf"] or len(header) != 4:
        raise source.fault(quoted(" ".join(header)), "'p cnf n m'; weighted clauses are format=wcnf", line)
    n, m = counts(source, line, header[2:], without_variables=True)
    clauses: list[list[int]] = []
    pending: list[int] = []
    begin = first_open = 0
    for number, words in listed:
        found = literals(source, number, words, n)
        first_open = first_open or (number if found[-1] else 0)
        for literal in found:
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
    ones: list[Exact] = [1] * m
    return from_clauses(source, "unsatisfied clauses", n, clauses, ones, [False] * m, unread(lines))
