"""Beasley's ``x'Qx``: ``n nnz``, then ``i j q`` counted from 1, i <= j."""

import numpy as np

from memcomp_lightning.problems.files.comments import unread
from memcomp_lightning.problems.files.objective import Parsed, Terms, from_terms
from memcomp_lightning.problems.files.source import Source
from memcomp_lightning.problems.files.table import Header, Table


def parse(source: Source, maximise: bool) -> Parsed:
    """``x'Qx`` with Q symmetric and listed where i <= j: an off-diagonal entry counts twice."""
    lines = source.lines()
    header = Header.read(source, lines, "variables", "entries")
    table = Table.after(header, source, lines, "entries", columns=(3,))
    i, j = table.pairs(1, max(header.n, 1), "variables")
    table.check(i <= j, "i <= j, the upper triangle of a symmetric matrix")
    twice = np.append(np.where(i == j, 1, 2), 1)
    terms = Terms("product", i, j, table.numbers().times(twice))
    remarks = [*header.remarks(), *unread(lines)]
    return from_terms(source, "x'Qx", header.n, terms, maximised=maximise, remarks=remarks)
