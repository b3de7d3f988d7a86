"""MAX-SAT with three literals a clause as a QUBO, for the solvers that know nothing else."""

import dataclasses
import functools

import torch

from memcomp_lightning.errors import require
from memcomp_lightning.problems import Qubo, WeightedMaxSat, to_qubo


@functools.lru_cache(maxsize=2)
def quadratise(problem: Qubo | WeightedMaxSat) -> Qubo:
    """Return a QUBO with the same minima; auxiliary variables, one a clause of three literals, come last.

    A clause costs w f g h, where f, g, h say that its literals are false, and
    f g h = min over a in {0, 1} of f g + g h + h f + a (1 - f - g - h) (Kolmogorov and Zabih 2004).
    """
    if isinstance(problem, Qubo):
        return problem
    short = to_qubo(dataclasses.replace(problem, longer=()))
    if not problem.longer:
        return short
    (block,) = problem.longer
    require(block.variables.shape[1] == 3, "longest clause", block.variables.shape[1], "3 literals")
    m = len(block.weight)
    weight, auxiliary = block.weight.double(), problem.n + torch.arange(m)
    # A literal of polarity q is false as constant + slope x.
    constant, slope = (1 + block.polarity.double()) / 2, -block.polarity.double()
    rows, columns, values, offset = [auxiliary], [auxiliary], [weight * (1 - constant.sum(1))], 0.0
    for k in range(3):
        i, j = block.variables[:, k], block.variables[:, (k + 1) % 3]
        s, t = slope[:, k], slope[:, (k + 1) % 3]
        a, b = constant[:, k], constant[:, (k + 1) % 3]
        rows += [i, i, j, auxiliary]
        columns += [j, i, j, i]
        values += [weight * s * t, weight * s * b, weight * a * t, -weight * s]
        offset += float((weight * a * b).sum())
    pairs = short.graph.edges()
    diagonal = torch.arange(problem.n)
    return Qubo.from_coo(
        problem.n + m,
        torch.cat((pairs[:, 0], diagonal, *rows)),
        torch.cat((pairs[:, 1], diagonal, *columns)),
        torch.cat((short.coupling.double(), short.linear.double(), *values)),
        short.offset.double() + offset,
    )
