"""The benchmark's problems, one generator a kind; ``families`` says which are used."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Generator, Tensor

from memcomp_lightning.problems import Bipartite, Qubo, WeightedMaxSat, read_problem


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Instance:
    """One problem and what is known about its minimum.

    Attributes:
        family: Rows of the table are families; the size is part of the name where there are several.
        name: Unique.
        problem: The problem.
        best_known: Lowest energy known, None if only the runs themselves can tell.
        how: "planted", "exact", "published", or "best of all runs".
    """

    family: str
    name: str
    problem: Qubo | WeightedMaxSat
    best_known: float | None = None
    how: str = "best of all runs"

    @property
    def digest(self) -> str:
        """Of the numbers: measurements belong to these, not to a name."""
        q, clauses = self.problem, getattr(self.problem, "longer", ())
        tensors = [q.coupling, q.linear] if isinstance(q, Qubo) else [q.weight, q.first, q.second, q.unit]
        tensors += [tensor for block in clauses for tensor in (block.variables, block.polarity, block.weight)]
        data = b"".join(tensor.contiguous().numpy().tobytes() for tensor in [*tensors, q.offset])
        return hashlib.sha256(data).hexdigest()[:12]


def normal(shape: tuple[int, ...], std: float, generator: Generator) -> Tensor:
    """Gaussian numbers."""
    return torch.empty(shape).normal_(0, std, generator=generator)


def random_rbm(
    n_visible: int, n_hidden: int, std: float, *, cancelled: float, bias_std: float, generator: Generator
) -> Qubo:
    """Gaussian weights; the biases are Gaussian, less the share ``cancelled`` of half the sum of the weights.

    With ``cancelled = 1`` the expected field of a unit among random others is its Gaussian bias alone: without
    one the problem is a spin glass without fields.
    """
    weight = normal((n_hidden, n_visible), std, generator)
    fields = normal((n_visible + n_hidden,), bias_std, generator)
    fields -= cancelled * torch.cat((weight.sum(0), weight.sum(1))) / 2
    return Qubo(Bipartite(n_visible, n_hidden), -weight, -fields, torch.zeros(()))


def max_cut(n: int, pairs: Tensor, weight: Tensor) -> Qubo:
    """Energy = -cut = -sum w (x_i + x_j - 2 x_i x_j)."""
    i, j = pairs.T
    return Qubo.from_coo(n, torch.cat((i, i, j)), torch.cat((j, i, j)), torch.cat((2 * weight, -weight, -weight)))


def random_graph(n: int, density: float, *, signs: bool, generator: Generator) -> Qubo:
    """Max-cut on a random graph like G1 (weights 1) or, with ``signs``, like G6 (weights -1 and 1)."""
    pairs = torch.triu_indices(n, n, offset=1).T
    pairs = pairs[torch.empty(len(pairs)).uniform_(generator=generator) < density]
    weight = torch.randint(2, (len(pairs),), generator=generator) * 2.0 - 1 if signs else torch.ones(len(pairs))
    return max_cut(n, pairs, weight)


def random_graph_of(n: int, n_edges: int, *, generator: Generator) -> Qubo:
    """Max-cut with weights -1 and 1 on a random graph, drawn edge by edge: no list of all pairs."""
    first = torch.randint(n, (n_edges,), generator=generator)
    second = (first + torch.randint(1, n, (n_edges,), generator=generator)) % n
    return max_cut(
        n, torch.stack((first, second), -1), torch.randint(2, (n_edges,), generator=generator) * 2.0 - 1
    )


def torus(side: int, *, generator: Generator) -> Qubo:
    """Max-cut on a square grid with periodic edges and weights -1 and 1, like G32."""
    node = torch.arange(side * side).view(side, side)
    pairs = torch.cat([torch.stack((node, node.roll(-1, axis)), -1).view(-1, 2) for axis in (0, 1)])
    return max_cut(side * side, pairs, torch.randint(2, (len(pairs),), generator=generator) * 2.0 - 1)


def beasley(n: int, *, generator: Generator) -> Qubo:
    """Density .1, integers from -100 to 100; off the diagonal an entry counts twice (Beasley 1998)."""
    i, j = torch.triu_indices(n, n)
    kept = torch.empty(len(i)).uniform_(generator=generator) < 0.1
    value = torch.randint(-100, 101, (len(i),), generator=generator).float() * (1 + (i != j))
    return Qubo.from_coo(n, i[kept], j[kept], value[kept])


def random_max_sat(n: int, n_clauses: int, length: int, *, generator: Generator) -> WeightedMaxSat:
    """Uniform clauses of different variables, integer weights from 1 to 10."""
    variables = torch.empty(n_clauses, n).uniform_(generator=generator).topk(length).indices + 1
    signs = torch.randint(2, (n_clauses, length), generator=generator) * 2 - 1
    weights = torch.randint(1, 11, (n_clauses,), generator=generator)
    return WeightedMaxSat.from_clauses(n, (variables * signs).tolist(), weights.tolist()).alike(weights)


def from_file(path: Path, *, maximise: bool = False) -> Qubo:
    """A G-set or Beasley file in float32, in which integers of these sizes are exact."""
    problem = read_problem(path, maximise=maximise).problem.alike(torch.zeros(()))
    return Qubo(problem.graph, problem.coupling.float(), problem.linear.float(), problem.offset.float())
