"""qbsolv's QUBO: ``p qubo topology n n_nodes n_couplers``, then ``i i q`` and ``i j q`` counted from 0."""

from memcomp_lightning.problems.files.comments import constant, unread
from memcomp_lightning.problems.files.objective import Parsed, Terms, from_terms
from memcomp_lightning.problems.files.source import Source, counts, filled, is_count, quoted
from memcomp_lightning.problems.files.table import Table


def parse(source: Source, maximise: bool) -> Parsed:
    """The sum of q x_i x_j over the lines; those with i = j are linear."""
    lines = source.lines()
    at, header = next(filled(lines), (1, lines[0]))
    words = header.partition("#")[0].split()
    if words[:2] != ["p", "qubo"] or len(words) != 6 or not all(map(is_count, words[3:])):
        raise source.fault(quoted(header), "'p qubo 0 n n_nodes n_couplers'", at)
    n, _ = counts(source, at, words[3:5])
    table = Table.read(source, lines, at, (3,))
    i, j = table.pairs(0, n - 1, "variables")
    n_nodes = int((i == j).sum())
    if [n_nodes, len(i) - n_nodes] != [int(words[4]), int(words[5])]:
        found = f"{n_nodes} nodes 'i i q' and {len(i) - n_nodes} couplers 'i j q'"
        raise source.fault(found, f"{words[4]} and {words[5]}, as line {at} says")
    offset, remarks = constant(source, lines)
    if words[2] not in ("0", "unconstrained"):
        remarks.append(f"The topology {quoted(words[2])} is not read.")
    remarks += unread(lines, counted=("offset", "constant"))
    terms = Terms("product", i, j, table.numbers(offset))
    return from_terms(source, "sum of q x_i x_j", n, terms, maximised=maximise, remarks=remarks)
