"""Beasley's ``x'Qx``: ``n nnz``, then ``i j q`` counted from 1, i <= j."""

import numpy as np

from memcomp_lightning.problems.files.objective import Parsed, Terms, from_terms
from memcomp_lightning.problems.files.source import Source
from memcomp_lightning.problems.files.table import Table


def parse(source: Source, maximise: bool) -> Parsed:
    """``x'Qx`` with Q symmetric and listed where i <= j: an off-diagonal entry counts twice."""
    lines = source.lines()
    n, table, remarks = Table.after_header(source, lines, "variables", "entries", columns=(3,))
    i, j = table.pairs(1, max(n, 1), "variables")
    table.check(i <= j, "i <= j, the upper triangle of a symmetric matrix")
    twice = np.append(np.where(i == j, 1, 2), 1)
    terms = Terms("product", i, j, table.numbers().times(twice))
    return from_terms(source, "x'Qx", n, terms, maximised=maximise, remarks=remarks)
