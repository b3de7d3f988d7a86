"""Problems with structure and hard clauses, as ours and as python-sat's."""

import itertools
import random
from collections.abc import Callable
from typing import NamedTuple

from pysat.card import CardEnc
from pysat.formula import WCNF

from memcomp_lightning.problems import Constrained, WeightedMaxSat, clause, exactly


class Instance(NamedTuple):
    """Weighted partial MAX-SAT.

    Attributes:
        n: Number of variables.
        hard: Clauses as in DIMACS.
        soft: Clauses and their weights.
        exactly: Numbers, and the variables (as in DIMACS) of which so many are 1.
    """

    n: int
    hard: list[list[int]]
    soft: list[tuple[list[int], int]]
    exactly: tuple[tuple[int, list[int]], ...] = ()

    def problem(self) -> Constrained:
        """As our solvers take it."""
        clauses, weights = ([entry[k] for entry in self.soft] for k in (0, 1))
        counts = [exactly(k, [i - 1 for i in variables]) for k, variables in self.exactly]
        objective = WeightedMaxSat.from_clauses(self.n, clauses, weights)
        return Constrained.of(objective, [*map(clause, self.hard), *counts])

    def formula(self) -> WCNF:
        """As RC2 takes it."""
        formula = WCNF()
        for literals in self.hard:
            formula.append(literals)
        for literals, weight in self.soft:
            formula.append(literals, weight=weight)
        top = self.n
        for k, variables in self.exactly:
            counter = CardEnc.equals(variables, k, top_id=top)
            top = max(top, counter.nv)
            formula.extend(counter.clauses)
        return formula


def vertex_cover(draw: random.Random, n: int, n_edges: int) -> Instance:
    """Every edge has an end in the cover; nodes have weights."""
    edges = [[i + 1, j + 1] for i, j in _pairs(n, n_edges, draw)]
    return Instance(n, edges, [([-i - 1], draw.randint(5, 25)) for i in range(n)])


def colouring(draw: random.Random, n_nodes: int, n_edges: int, n_colours: int = 3) -> Instance:
    """One colour for each node; edges between nodes of one colour cost, and three in ten are not allowed."""
    at = [[n_colours * i + c + 1 for c in range(n_colours)] for i in range(n_nodes)]
    hard = [*at, *([-a, -b] for node in at for a, b in itertools.combinations(node, 2))]
    soft = list[tuple[list[int], int]]()
    for i, j in _pairs(n_nodes, n_edges, draw):
        clauses = [[-a, -b] for a, b in zip(at[i], at[j], strict=True)]
        if draw.random() < 0.3:
            hard += clauses
        else:
            weight = draw.randint(1, 9)
            soft += [(literals, weight) for literals in clauses]
    return Instance(n_nodes * n_colours, hard, soft)


def scheduling(draw: random.Random, n_jobs: int, n_times: int, n_conflicts: int) -> Instance:
    """Jobs at one time at most, some not together, some after others; one that is left out costs its value."""
    at = [[n_times * job + time + 1 for time in range(n_times)] for job in range(n_jobs)]
    hard = [[-a, -b] for job in at for a, b in itertools.combinations(job, 2)]
    soft = [(job, draw.randint(10, 40)) for job in at]
    soft += [([-variable], draw.randint(1, 9)) for job in at for variable in job if draw.random() < 0.4]
    for one, other in _pairs(n_jobs, n_conflicts, draw):
        hard += [[-a, -b] for a, b in zip(at[one], at[other], strict=True)]
    for before, after in _pairs(n_jobs, n_jobs // 3, draw):
        hard += [[-at[after][time], *at[before][:time]] for time in range(n_times)]
    return Instance(n_jobs * n_times, hard, soft)


def random_clauses(draw: random.Random, n: int, n_hard: int, n_soft: int) -> Instance:
    """Hard clauses of three literals that a hidden state satisfies, and soft ones of one to three."""
    hidden, hard = [draw.random() < 0.5 for _ in range(n)], list[list[int]]()
    while len(hard) < n_hard:
        literals = _clause(n, 3, draw)
        if any(hidden[abs(q) - 1] == (q > 0) for q in literals):
            hard.append(literals)
    soft = [(_clause(n, draw.choice([1, 2, 2, 3]), draw), draw.randint(1, 20)) for _ in range(n_soft)]
    return Instance(n, hard, soft)


def potts(draw: random.Random, n_nodes: int, n_edges: int, n_colours: int = 3) -> Instance:
    """Exactly one colour for each node; edges between nodes of one colour cost."""
    at = [[n_colours * i + c + 1 for c in range(n_colours)] for i in range(n_nodes)]
    soft = list[tuple[list[int], int]]()
    for i, j in _pairs(n_nodes, n_edges, draw):
        weight = draw.randint(1, 9)
        soft += [([-a, -b], weight) for a, b in zip(at[i], at[j], strict=True)]
    return Instance(n_nodes * n_colours, [], soft, tuple((1, node) for node in at))


def k_of_n(draw: random.Random, n: int, k: int) -> Instance:
    """Exactly k of n, of which every two cost something together."""
    soft = [([-i, -j], draw.randint(1, 20)) for i, j in itertools.combinations(range(1, n + 1), 2)]
    return Instance(n, [], soft, ((k, list(range(1, n + 1))),))


def _pairs(n: int, n_pairs: int, draw: random.Random) -> list[tuple[int, ...]]:
    return draw.sample(list(itertools.combinations(range(n), 2)), n_pairs)


def _clause(n: int, length: int, draw: random.Random) -> list[int]:
    return [draw.choice([-1, 1]) * i for i in draw.sample(range(1, n + 1), length)]


FAMILIES: dict[Callable[..., Instance], list[tuple[int, ...]]] = {
    vertex_cover: [(100, 240), (150, 360), (200, 500), (400, 900)],
    colouring: [(20, 50), (30, 90, 4), (60, 150), (60, 240, 4)],
    scheduling: [(12, 5, 24), (20, 6, 60), (40, 8, 200)],
    random_clauses: [(60, 150, 120), (100, 300, 150), (100, 380, 200)],
    potts: [(20, 50), (30, 90), (60, 180)],
    k_of_n: [(30, 6), (60, 15), (120, 30)],
}
"""Sizes of each family's instances."""
