"""Matrix Market: a square matrix Q, coordinates or all entries, general or symmetric."""

import numpy as np

from memcomp_lightning.problems.files.comments import unread
from memcomp_lightning.problems.files.objective import Parsed, Terms, from_terms
from memcomp_lightning.problems.files.source import Source, counts, filled, quoted
from memcomp_lightning.problems.files.table import Table

BANNER = "%%MatrixMarket"
_ALLOWED = (("matrix",), ("coordinate", "array"), ("integer", "real", "pattern"), ("general", "symmetric"))


def parse(source: Source, maximise: bool) -> Parsed:
    """``x'Qx`` with the whole matrix: a symmetric file lists one triangle, whose entries stand for both."""
    lines = source.lines()
    words = lines[0].lower().split()
    if words[:1] != [BANNER.lower()] or len(words) != 5:
        raise source.fault(quoted(lines[0]), f"'{BANNER} matrix coordinate real symmetric' or another kind", 1)
    for word, allowed in zip(words[1:], _ALLOWED, strict=True):
        if word not in allowed:
            raise source.fault(quoted(word), " or ".join(allowed), 1)
    coordinate, pattern, symmetric = (kind in words for kind in ("coordinate", "pattern", "symmetric"))
    at, size = next(filled(lines, 1), (2, ""))
    numbers = size.split()
    if len(numbers) != (3 if coordinate else 2) or numbers[0] != numbers[1]:
        expected = "'rows columns entries'" if coordinate else "'rows columns'"
        raise source.fault(quoted(size), f"{expected} of a square matrix", at)
    n, n_entries = counts(source, at, [numbers[0], numbers[-1]])
    if coordinate:
        table = Table.read(source, lines, at, (2,) if pattern else (3,))
        i, j = table.pairs(1, max(n, 1), "indices")
    else:
        if pattern:
            raise source.fault("an array of pattern", "coordinates of a pattern", 1)
        table = Table.read(source, lines, at, (1,))
        n_entries = n * (n + 1) // 2 if symmetric else n * n
    if len(table.values) != n_entries:
        raise source.fault(f"{len(table.values)} entries", f"{n_entries}, as line {at} says")
    if not coordinate:
        j, i = np.triu_indices(n) if symmetric else np.indices((n, n)).reshape(2, -1)
    factors, remarks = np.ones(len(i) + 1, np.int64), unread(lines[1:])
    if symmetric:
        if coordinate:
            table.check(i >= j, "i >= j, the lower triangle of a symmetric matrix")
        factors[:-1][i != j] = 2
        remarks.append("An entry off the diagonal stands for (i, j) and (j, i): it counts twice in x'Qx.")
    terms = Terms("product", i.astype(np.int64), j.astype(np.int64), table.numbers().times(factors))
    return from_terms(source, "x'Qx", n, terms, maximised=maximise, remarks=remarks)
