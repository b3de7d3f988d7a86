"""Mean-field inference of hidden units that are coupled to each other."""

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor


class ClassedModel(Protocol):
    """A model whose units fall into classes without couplings inside."""

    @property
    def n_visible(self) -> int:
        """Number of visible units, which are numbered first."""
        ...

    @property
    def n_hidden(self) -> int:
        """Number of hidden units."""
        ...

    def blocks(self) -> Sequence[Any]:
        """The classes with their couplings (:class:`memcomp_lightning.models.boltzmann.Block`)."""
        ...


class MeanFieldSolution(NamedTuple):
    """Means of the hidden units given the visible ones.

    Attributes:
        h: ``(*replicas, n, n_hidden)`` in (0, 1).
        change: Largest change of a mean in the last iteration, ``(*replicas,)``.
        converged: Whether it is below the tolerance, ``(*replicas,)``.
        n_iterations: Iterations done.
    """

    h: Tensor
    change: Tensor
    converged: Tensor
    n_iterations: int


@torch.no_grad()
def mean_field(
    model: ClassedModel, v: Tensor, *, max_iterations: int = 30, tolerance: float = 1e-3
) -> MeanFieldSolution:
    r"""Iterate ``h_i = sigmoid(field_i(v, h))``, class by class, from 1/2.

    Each update of a class minimises the Kullback-Leibler divergence of the factorised distribution from
    p(h | v) in its means, so that it falls with every iteration (Peterson & Anderson 1987). One iteration is exact
    if no two hidden units are coupled. It stops when no mean changes by more than the tolerance, or says that it
    did not converge.

    Args:
        model: The machine.
        v: Visible units in [0, 1], ``(*replicas, n, n_visible)``.
        max_iterations: >= 1.
        tolerance: > 0.
    """
    n_visible = model.n_visible
    x = torch.cat((v, v.new_full((*v.shape[:-1], model.n_hidden), 0.5)), dim=-1)
    blocks = hidden_blocks(model)
    coupled = any(bool((block.neighbours >= n_visible).any()) for block in blocks)
    change = v.new_zeros(v.shape[:-2])
    n_iterations = 0
    for n_iterations in range(1, (max_iterations if coupled else 1) + 1):  # noqa: B007
        change = torch.zeros_like(change)
        for block in blocks:
            mean = torch.sigmoid(block.field(x))
            change = torch.maximum(change, (mean - x[..., block.units]).abs().amax((-2, -1)))
            x[..., block.units] = mean
        if not coupled:
            change = torch.zeros_like(change)
        if bool((change < tolerance).all()):
            break
    return MeanFieldSolution(x[..., n_visible:], change, change < tolerance, n_iterations)


def hidden_blocks(model: ClassedModel) -> list[Any]:
    """The hidden units of each class, without the classes that have none."""
    found = []
    for block in model.blocks():
        keep = (block.units >= model.n_visible).nonzero().flatten()
        if len(keep):
            weight, bias = block.weight.index_select(-2, keep), block.bias.index_select(-1, keep)
            found.append(block._replace(units=block.units[keep], weight=weight, bias=bias))
    return found
