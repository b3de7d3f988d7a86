"""Mean-field inference of units that are coupled to each other, with others clamped."""

from collections.abc import Callable
from itertools import islice
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.affine import affine, plus_product
from memcomp_lightning.models.base import Block, EnergyModel, Hidden, PerState, Visible


class MeanFieldSolution(NamedTuple):
    """Means of the free units, usually the hidden ones.

    Attributes:
        h: ``(*replicas, n, n_free)``.
        change: Largest change of a mean in the last iteration of its configuration, ``(*replicas,)``.
        converged: Whether it is below the tolerance, ``(*replicas,)``.
        n_iterations: Iterations done, those of the configuration that took longest.
        v: The visible units, with the means of those that were not observed.
    """

    h: Tensor
    change: Tensor
    converged: Tensor
    n_iterations: int
    v: Tensor


@torch.no_grad()
def mean_field(
    model: EnergyModel,
    given: Tensor,
    *,
    clamped: Literal["visible", "hidden"] = "visible",
    observed: Tensor | None = None,
    max_iterations: int = 30,
    tolerance: float = 1e-3,
) -> MeanFieldSolution:
    r"""Approximate the means of the free units: iterate ``m = mean(field)``, class by class, from zero fields.

    Each update of a class minimises the Kullback-Leibler divergence of the factorised distribution from
    p(free | clamped) in its means, so that it falls with every iteration (Peterson & Anderson 1987). One iteration
    is exact if no two free units are coupled. Each configuration stops on its own when all its means change by
    less than the tolerance > 0, so that they do not depend on the rest of the batch. If one does not get there in
    ``max_iterations`` >= 1, ``converged`` of its replica is False.

    ``given`` are the clamped units, ``(*replicas, n, n_visible)`` or ``(*replicas, n, n_hidden)``. Where visible
    units are clamped, ``observed``, a mask of their shape, says which; the others are free, like the hidden ones.
    """
    n_visible = model.n_visible
    free = slice(n_visible, None) if clamped == "visible" else slice(0, n_visible)
    n_free = model.n_hidden if clamped == "visible" else n_visible
    free_units = model.hidden if clamped == "visible" else model.visible
    unknown = free_units.mean(given.new_zeros(*given.shape[:-1], n_free))
    fixed: Tensor | None = None
    if observed is None:
        blocks = _free_blocks(model, clamped)
        coupled = any(bool(_among(block.neighbours, n_visible, clamped).any()) for block in blocks)
    else:
        require(clamped == "visible", "clamped", clamped, "'visible' where a mask says which are observed")
        given = torch.where(observed, given, model.visible.mean(torch.zeros_like(given)))
        fixed = torch.cat((observed, torch.zeros_like(unknown, dtype=torch.bool)), dim=-1)
        blocks, coupled = list(model.blocks()), True
    x = torch.cat((given, unknown) if clamped == "visible" else (unknown, given), dim=-1)
    if not coupled:
        for block in blocks:
            x[..., block.units] = block.kind.mean(block.field(x))
        change = given.new_zeros(given.shape[:-2])
        return MeanFieldSolution(x[..., free], change, change < tolerance, 1, x[..., :n_visible])
    # The field of clamped units stays as it is: iterations are of the free ones.
    places = [_run(block.units) for block in blocks]
    fields = [_given_clamped(block, x, n_visible, clamped) if fixed is None else block.field for block in blocks]
    change = given.new_full(given.shape[:-1], torch.inf)
    n_iterations = 0
    for n_iterations in range(1, max_iterations + 1):  # noqa: B007
        moves = change >= tolerance
        now = torch.zeros_like(change)
        for block, at, field in zip(blocks, places, fields, strict=True):
            old = _taken(x, at)
            may_move = moves.unsqueeze(-1) if fixed is None else moves.unsqueeze(-1) & ~fixed[..., block.units]
            mean = torch.where(may_move, block.kind.mean(field(x)), old)
            now = torch.maximum(now, (mean - old).abs().amax(-1))
            x[..., at] = mean
        change = torch.where(moves, now, change)
        if not bool((change >= tolerance).any()):
            break
    largest = change.amax(-1)
    return MeanFieldSolution(x[..., free], largest, largest < tolerance, n_iterations, x[..., :n_visible])


def _given_clamped(block: Block, x: Tensor, n_visible: int, clamped: str) -> Callable[[Tensor], Tensor]:
    """The field of a block as a function of all units, of which those that are clamped keep their values."""
    moves = _among(block.neighbours, n_visible, clamped)
    if bool(moves.all()):
        return block.field
    parts = []
    for which in (~moves, moves):
        at = which.nonzero().flatten()
        parts.append((_run(block.neighbours[at]), _taken(block.weight, _run(at))))
    (fixed, of_fixed), (others, of_others) = parts
    still = affine(_taken(x, fixed), of_fixed, block.bias)
    return lambda x: plus_product(still.clone(), _taken(x, others), of_others.mT)


def _run(at: Tensor) -> Tensor | slice:
    """Places as a slice, where they follow each other: a view instead of a copy."""
    first, last = (int(at[0]), int(at[-1])) if len(at) else (0, -1)
    return slice(first, last + 1) if last - first + 1 == len(at) else at


def _taken(x: Tensor, at: Tensor | slice) -> Tensor:
    return x[..., at] if isinstance(at, slice) else x.index_select(-1, at)


def free_energy_of_means(model: EnergyModel, v: Visible, h: Hidden) -> PerState:
    r"""``E(v, m) - \sum_i H(m_i)`` of given means m of the hidden units: an upper bound of F(v)."""
    return model.energy(v, h) + model.hidden.negative_entropy(h)


def hidden_blocks(model: EnergyModel) -> list[Block]:
    """The hidden units of each class, without the classes that have none."""
    return _free_blocks(model, "visible")


def _among(units: Tensor, n_visible: int, clamped: str) -> Tensor:
    """Which units are free."""
    return units >= n_visible if clamped == "visible" else units < n_visible


def _free_blocks(model: EnergyModel, clamped: str) -> list[Block]:
    """The free units of each class, without the classes that have none."""
    found: list[Block] = []
    if not (model.n_hidden if clamped == "visible" else model.n_visible):
        return found
    blocks = model.blocks()
    units = torch.cat([block.units for block in blocks])
    # One look at the device for all classes, of which a machine may have hundreds.
    is_free = iter(_among(units, model.n_visible, clamped).tolist())
    for block in blocks:
        places = [place for place, free in enumerate(islice(is_free, block.kind.n)) if free]
        if len(places) == block.kind.n:
            found.append(block)
        elif places:
            keep = _among(block.units, model.n_visible, clamped).nonzero().flatten()
            couplings, bias = block.couplings.index_select(-2, keep), block.bias.index_select(-1, keep)
            found.append(Block(block.units[keep], block.neighbours, couplings, bias, block.kind.select(keep)))
    return found
