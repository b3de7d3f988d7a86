"""Which units of a Boltzmann machine are coupled, and groups of units that are not."""

from collections import deque
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

from memcomp_lightning.errors import require, require_count

Pairs = Int[Tensor, "n_pairs 2"]
"""Coupled units, each pair once, the lower index first, in ascending order."""

_NONE = torch.empty(0, 2, dtype=torch.long)


def full(n_units: int) -> Pairs:
    """Every pair.

    >>> full(3).tolist()
    [[0, 1], [0, 2], [1, 2]]
    """
    require_count("n_units", n_units)
    return torch.combinations(torch.arange(n_units, device="cpu")) if n_units > 1 else _NONE


def layered(sizes: Sequence[int]) -> Pairs:
    """Every unit of a layer with every unit of the next: an RBM for two sizes, a DBM for more.

    >>> layered([1, 2, 1]).tolist()
    [[0, 1], [0, 2], [1, 3], [2, 3]]
    """
    for size in sizes:
        require_count("size of a layer", size)
    bounds = torch.tensor([0, *sizes], device="cpu").cumsum(0).tolist()
    layers = [torch.arange(start, stop, device="cpu") for start, stop in pairwise(bounds)]
    return torch.cat([torch.cartesian_prod(lower, upper) for lower, upper in pairwise(layers)] or [_NONE])


def semi_restricted(n_visible: int, n_hidden: int) -> Pairs:
    """Every pair of visible units, every visible unit with every hidden one, and no hidden pair.

    (Osindero & Hinton 2007: a semi-restricted Boltzmann machine.)

    >>> semi_restricted(2, 2).tolist()
    [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3]]
    """
    require_count("n_visible", n_visible)
    require_count("n_hidden", n_hidden, minimum=0)
    pairs = full(n_visible + n_hidden)
    return pairs[pairs[:, 0] < n_visible]


def grid(n_rows: int, n_columns: int) -> Pairs:
    """Neighbours in a rectangle, units row by row.

    >>> grid(2, 2).tolist()
    [[0, 1], [0, 2], [1, 3], [2, 3]]
    """
    require_count("n_rows", n_rows)
    require_count("n_columns", n_columns)
    at = torch.arange(n_rows * n_columns, device="cpu").view(n_rows, n_columns)
    right = torch.stack((at[:, :-1], at[:, 1:]), dim=-1).view(-1, 2)
    down = torch.stack((at[:-1], at[1:]), dim=-1).view(-1, 2)
    return from_pairs(at.numel(), torch.cat((right, down)))


def neighbours(height: int, width: int, pixels: Sequence[int] | None = None) -> Pairs:
    """Neighbours in a picture of which only some pixels are units.

    Args:
        height: Rows of the picture, >= 1.
        width: Columns of the picture, >= 1.
        pixels: Pixel of each unit, counted row by row from 0; None means all of them, in order.

    >>> neighbours(2, 2, [3, 0, 1]).tolist()
    [[0, 2], [1, 2]]
    """
    pairs = grid(height, width)
    if pixels is None:
        return pairs
    unit_of = {pixel: unit for unit, pixel in enumerate(pixels)}
    kept = [(unit_of[a], unit_of[b]) for a, b in pairs.tolist() if a in unit_of and b in unit_of]
    return from_pairs(len(pixels), kept)


def from_graph(graph: Any) -> Pairs:
    """Edges of a networkx graph, its nodes numbered in ascending order: ``dwave.graphs.zephyr_graph(2)``, say."""
    number = {node: index for index, node in enumerate(sorted(graph.nodes))}
    edges = [(number[first], number[second]) for first, second in graph.edges]
    return from_pairs(len(number), torch.tensor(edges, dtype=torch.long, device="cpu").view(-1, 2))


def from_file(path: str | Path | None, n_visible: int) -> Pairs:
    """Edges of a text file: two numbers of units a line, from 0, by blanks or a comma; ``#`` begins a comment.

    Args:
        path: The file.
        n_visible: Number of units that edges may join.

    Raises:
        SettingError: There is no such file, a line is something else, or a pair is not allowed.
    """
    path = Path(path or "")
    require(path.is_file(), "model.connectivity.path", str(path), "a text file of edges, two numbers a line")
    pairs = []
    for number, line in enumerate(path.read_text(encoding="utf-8", errors="replace").splitlines(), start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        valid = len(words) in (0, 2) and all(word.isdecimal() for word in words)
        require(valid, f"{path}, line {number}", line.strip(), "two numbers of units, from 0")
        if words:
            pairs.append((int(words[0]), int(words[1])))
    return from_pairs(n_visible, pairs)


def from_mask(mask: Tensor) -> Pairs:
    """The pairs of a symmetric matrix ``(n, n)``, True or other than zero where two units are coupled.

    Raises:
        SettingError: It is not square, not symmetric, or couples a unit to itself.
    """
    require(mask.ndim == 2 and mask.shape[0] == mask.shape[1], "shape of the mask", tuple(mask.shape), "(n, n)")
    mask = mask != 0
    one_way = (mask ^ mask.mT).nonzero()[:1].tolist()
    allowed = "a symmetric matrix: a coupling has no direction"
    require(not one_way, "mask", f"asymmetric at {one_way}", allowed, "Use mask | mask.T.")
    itself = mask.diagonal().nonzero()[:1].flatten().tolist()
    require(not itself, "mask", f"unit {itself} coupled to itself", "a diagonal of zeros; what is there is a bias")
    return mask.triu().nonzero()


def from_pairs(n_units: int, pairs: Int[Tensor, "n_pairs 2"] | Iterable[tuple[int, int]]) -> Pairs:
    """Bring a list of pairs into order.

    Raises:
        SettingError: A unit that does not exist, a pair given twice (in either order), a unit with itself.
    """
    require_count("n_units", n_units)
    given = torch.as_tensor(pairs if isinstance(pairs, Tensor) else list(pairs), dtype=torch.long, device="cpu")
    require(given.numel() == 0 or (given.ndim == 2 and given.shape[1] == 2), "pairs", tuple(given.shape), "(n, 2)")
    given = given.view(-1, 2)
    outside = given[(given < 0) | (given >= n_units)][:1].tolist()
    require(not outside, "unit of a pair", outside, f"0 to n_units - 1 = {n_units - 1}")
    itself = given[given[:, 0] == given[:, 1]][:1].tolist()
    require(not itself, "pair", itself, "two different units; a unit with itself is a bias")
    ordered, _ = given.sort(dim=-1)
    key, count = (ordered[:, 0] * n_units + ordered[:, 1]).unique(return_counts=True)
    twice = key[count > 1][:1]
    require(not len(twice), "pair", [(int(k) // n_units, int(k) % n_units) for k in twice], "each pair once")
    return torch.stack((key // n_units, key % n_units), dim=-1)


def colouring(n_units: int, pairs: Pairs) -> list[Int[Tensor, " n_class"]]:
    """Split the units into classes without couplings inside, so that a class can be drawn at once.

    Two classes where two suffice (an RBM, a DBM, a grid); otherwise the better of two greedy colourings, outwards
    from the first unit and by degree. There are at most k + 1 classes if no unit has more than k couplings.

    >>> [units.tolist() for units in colouring(4, grid(2, 2))]
    [[0, 3], [1, 2]]
    """
    neighbours: list[list[int]] = [[] for _ in range(n_units)]
    for first, second in pairs.tolist():
        neighbours[first].append(second)
        neighbours[second].append(first)
    by_degree = sorted(range(n_units), key=lambda unit: -len(neighbours[unit]))
    found = min((_greedy(neighbours, order) for order in (_outwards(neighbours), by_degree)), key=max)
    colours = torch.tensor(found, device="cpu")
    return [(colours == colour).nonzero().flatten() for colour in range(max(found) + 1)]


def pairs_of(n_units: int, connectivity: Tensor | Iterable[tuple[int, int]] | None) -> Pairs:
    """The pairs that a connectivity names: a mask, a list of pairs, or None for all."""
    if connectivity is None:
        return full(n_units)
    if isinstance(connectivity, Tensor) and connectivity.shape == (n_units, n_units) != (2, 2):
        return from_mask(connectivity)
    if isinstance(connectivity, Tensor) and (connectivity.ndim != 2 or connectivity.shape[1] != 2):
        require(False, "shape of connectivity", tuple(connectivity.shape), f"{(n_units, n_units)} or (n_pairs, 2)")
    return from_pairs(n_units, connectivity)


def _greedy(neighbours: list[list[int]], order: Sequence[int]) -> list[int]:
    colour = [-1] * len(neighbours)
    for unit in order:
        taken = {colour[other] for other in neighbours[unit]}
        colour[unit] = next(number for number in range(len(neighbours)) if number not in taken)
    return colour


def _outwards(neighbours: list[list[int]]) -> list[int]:
    """Breadth first from each part's first unit: greedy colouring in this order needs two colours if two do."""
    order: dict[int, None] = {}  # in order of insertion
    for start in range(len(neighbours)):
        waiting = deque([start])
        while waiting:
            unit = waiting.popleft()
            if unit not in order:
                order[unit] = None
                waiting.extend(neighbours[unit])
    return list(order)
