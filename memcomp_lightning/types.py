"""The values that models, samplers and modules hand to each other. No logic.

Shapes: every tensor may carry leading replica axes ``*replicas``, over which all functions broadcast.
"""

from typing import Generic, NamedTuple, TypeVar

from torch import Tensor

StateT = TypeVar("StateT")

UNLABELLED = -1
"""The class of a row that has none."""


class Configurations(NamedTuple):
    """Joint states of visible and hidden units.

    Attributes:
        v: Visible units, ``(*replicas, n, n_visible)``.
        h: Hidden units, samples or conditional means, ``(*replicas, n, n_hidden)``.
        weight: Unnormalised weights with a sum > 0, ``(*replicas, n)``; None means uniform. They are >= 0 but for
            a sampler of ``signed_weights``, where the gradient of the mean energy is what counts.
    """

    v: Tensor
    h: Tensor
    weight: Tensor | None = None


class Weighted(NamedTuple):
    """Configurations in a sum: v ``(*replicas, n, n_visible)``, h, and a weight of any sign ``(*replicas, n)``."""

    v: Tensor
    h: Tensor
    weight: Tensor


class NegativePhase(NamedTuple, Generic[StateT]):
    """What a sampler returns for one update.

    Attributes:
        configurations: The states whose mean energy stands for the expectation under the model.
        state: What the next call needs (chains), a NamedTuple of tensors; never shared with the caller's.
        info: Diagnostics, ``(*replicas,)`` or scalar each: logged, never read back.
    """

    configurations: Configurations
    state: StateT
    info: dict[str, Tensor]


class NoState(NamedTuple):
    """The state of a sampler that remembers nothing."""


class Batch(NamedTuple):
    """Images of one optimiser step, or one chunk of them when the step's images are too many at once.

    Attributes:
        v: Values of the visible units, for pictures intensities in [0, 1], ``(*replicas, n, n_visible)``.
        label: Class indices (int64), ``(*replicas, n)``; :data:`UNLABELLED` where there is none.
        share: ``n_processes * n / n_step``, where ``n_step`` counts the images of the step over all its
            chunks and processes, each by its weight. The gradient of ``share * mean over this batch``, summed
            over the chunks and averaged over the processes, is the gradient of the mean over the step's images.
        closes_step: Whether the optimiser steps after this chunk.
        weight: How often each image counts, > 0, ``(*replicas, n)``; None means once.
        observed: Where values of ``v`` are known, a mask of its shape; None is everywhere.
    """

    v: Tensor
    label: Tensor
    share: float
    closes_step: bool
    weight: Tensor | None = None
    observed: Tensor | None = None
