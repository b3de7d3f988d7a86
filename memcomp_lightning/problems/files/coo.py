"""The coordinate list of dimod: ``i j bias`` counted from 0, what x is and a constant in comments."""

import re

from memcomp_lightning.problems.files.comments import IS, comments, constant, said, unread
from memcomp_lightning.problems.files.objective import Parsed, Terms, from_terms
from memcomp_lightning.problems.files.source import MOST_VARIABLES, Source, quoted
from memcomp_lightning.problems.files.table import Table

_VARTYPE = re.compile(rf"\bvar[-_ ]?type\b{IS}(?:dimod\.)?(?:vartype\.)?(?P<value>spin|binary)\b", re.IGNORECASE)
_NAMES_VARTYPE = re.compile(r"var[-_ ]?type", re.IGNORECASE)
_SPINS = re.compile(r"\bspins?\b|\bising\b", re.IGNORECASE)
_COUNTED = ("offset", "constant", "vartype", "var_type", "var-type")
_OTHER = re.compile(r"[\"']?\b([A-Za-z_][\w-]*)[\"']?\s*[:=]\s*([^\s,;}]+)", re.ASCII)


def parse(source: Source, maximise: bool) -> Parsed:
    """``i j bias`` with x in {0, 1}, or s = 2 x - 1 in {-1, 1}; i = j is linear.

    dimod writes into a comment whether the file has x or s, and leaves out a model's constant; ``# offset=3``
    gives one. Writing s in terms of x adds another: with it the energy of every state is that of the file.
    """
    lines = source.lines()
    vartype = said(source, lines, _VARTYPE, _NAMES_VARTYPE, _TYPES)
    offset, counted = constant(source, lines)
    if vartype is None and (spins := next((entry for entry in comments(lines) if _SPINS.search(entry[1])), None)):
        raise source.fault(quoted(spins[1]), f"also a comment {_TYPES}", spins[0])
    table = Table.read(source, lines, 0, (3,))
    if not len(table.values) and vartype is None:
        raise source.fault("no entries", "lines 'i j bias'")
    i, j = table.pairs(0, MOST_VARIABLES - 1, "variables")
    kind = (vartype or "BINARY").upper()
    terms = Terms("spin" if kind == "SPIN" else "product", i, j, table.numbers(offset))
    n = 1 + max(int(i.max(initial=-1)), int(j.max(initial=-1)))
    remarks = [] if len(table.values) else ["There are no entries: the sum is empty."]
    remarks += [*counted, *unread(lines, _COUNTED, _OTHER)]
    return from_terms(source, f"{kind} energy", n, terms, maximised=maximise, remarks=remarks)


_TYPES = "'# vartype=SPIN' or '# vartype=BINARY'"
