"""The G-set's MAX-CUT: ``n m``, then ``i j w`` counted from 1."""

import numpy as np

from memcomp_lightning.problems.files.objective import Parsed, Terms, from_terms
from memcomp_lightning.problems.files.source import Source
from memcomp_lightning.problems.files.table import Table


def parse(source: Source, maximise: bool) -> Parsed:
    """MAX-CUT, maximised in any case. The energy is -cut = sum of w (2 x_i x_j - x_i - x_j)."""
    lines = source.lines()
    n, table, remarks = Table.after_header(source, lines, "vertices", "edges", columns=(3, 2))
    i, j = table.pairs(1, max(n, 1), "vertices")
    loops = np.flatnonzero(i == j)
    if len(loops):
        number, line = table.row(int(loops[0]))
        remarks.append(
            f"{len(loops)} self-loop{'s' if len(loops) > 1 else ''} (line {number}: {' '.join(line.split())}): "
            "adds nothing to a cut. In x'Qx it would: format=beasley."
        )
    terms = Terms("cut", i, j, table.numbers())
    return from_terms(source, "cut weight", n, terms, maximised=True, remarks=remarks)
