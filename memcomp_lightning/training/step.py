"""One update of an energy model: what Lightning's loop and the bare loop on the replica axis have in common."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Generator, Tensor

from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.objective import Centring, Offsets, add_gradient, contrast
from memcomp_lightning.samplers.base import NegativePhaseSampler, require_sampler
from memcomp_lightning.training.penalties import Penalty, with_penalties
from memcomp_lightning.types import Configurations, NegativePhase

Sampler: TypeAlias = NegativePhaseSampler[Any, Any]
"""A sampler of the negative phase, for whatever models and with whatever state."""


class Processes:
    """The processes that share an update, each with images of its own: here one, alone."""

    def means(self, values: Sequence[Tensor], share: float | None = None) -> Sequence[Tensor]:
        """The mean of each value over all of them, in which this one counts by its share; None is all alike."""
        return values

    def from_first(self, make: Callable[[], NegativePhase[object]]) -> NegativePhase[object]:
        """What the first one makes, in all of them."""
        return make()


class StepState(NamedTuple):
    """What the training of a model carries from one batch of images to the next.

    Attributes:
        sampler: State of the sampler; None before the first update.
        offsets: Centres of the units; None before the first update, and without centring.
        negative: Negative phase of an update whose images are not all in yet.
    """

    sampler: object = None
    offsets: Offsets | None = None
    negative: NegativePhase[object] | None = None

    def after_update(self) -> "StepState":
        """The optimiser has stepped: the next batch begins another update."""
        return self._replace(negative=None)


@dataclass(frozen=True, kw_only=True)
class EnergyStep:
    r"""Computes the loss of an update, ``mean E(positive) - mean E(negative)``, batch by batch.

    The images of an update may come in several batches. The first one moves the offsets; one negative phase serves
    all of them, unless the sampler starts at the data.

    Attributes:
        sampler: Supplies the negative phase.
        centring: Settings of the centred gradient; None follows the plain one.
        penalties: What the couplings cost beside the contrast.
        processes: Those that share the update.
    """

    sampler: Sampler
    centring: Centring | None = None
    penalties: Sequence[Penalty] = ()
    processes: Processes = field(default_factory=Processes)

    def __post_init__(self) -> None:
        require_sampler("sampler", self.sampler)

    def contrast(
        self,
        model: EnergyModel,
        positive: Configurations,
        state: StepState,
        *,
        share: float = 1.0,
        generator: Generator,
    ) -> tuple[Tensor, NegativePhase[object], StepState]:
        """Return the contrast ``(*replicas,)``, whose gradient is followed, the negative phase, and the new state.

        Args:
            model: The energy model; not changed.
            positive: The positive phase of the batch, with its weights.
            state: What the call before returned, ``after_update()`` where the update was complete.
            share: Of the batch, as for :meth:`loss`: how far it counts in centres that processes share.
            generator: Of the negative phase.
        """
        negative, state = self._begun(model, positive, state, share, generator)
        return contrast(model, positive, negative.configurations, state.offsets), negative, state

    def add_gradient(
        self,
        model: EnergyModel,
        positive: Configurations,
        state: StepState,
        *,
        share: float,
        generator: Generator,
        valued: bool = True,
    ) -> tuple[Tensor | None, NegativePhase[object], StepState]:
        """Add the gradient of a batch to those of the parameters; return as :meth:`contrast`, without a graph.

        ``share`` is that of the batch, as for :meth:`loss`. With ``valued=False`` nobody looks at the contrast,
        and None may be in its place.
        """
        negative, state = self._begun(model, positive, state, share, generator)
        gap = add_gradient(model, positive, negative.configurations, state.offsets, share=share, valued=valued)
        if self.penalties:
            self.loss(model, torch.zeros_like(model.b[..., 0]), share).backward()
        return gap, negative, state

    def loss(self, model: EnergyModel, gap: Tensor, share: float) -> Tensor:
        """Return what a batch adds to the loss of the update, whose gradient is followed, a scalar.

        Shares of the batches of an update add up to one, so that the penalties count once, whatever the number of
        batches and processes.

        Args:
            model: The energy model.
            gap: Its contrast on the batch, ``(*replicas,)``.
            share: Of the batch, see :class:`memcomp_lightning.types.Batch`.
        """
        return share * with_penalties(gap, model, self.penalties).sum()

    def _begun(
        self, model: EnergyModel, positive: Configurations, state: StepState, share: float, generator: Generator
    ) -> tuple[NegativePhase[object], StepState]:
        """The negative phase for a batch, and the state after it."""
        offsets, negative = state.offsets, state.negative
        if negative is None and self.centring is not None:
            offsets = Offsets(*self.processes.means(self.centring.follow(offsets, positive), share))
        if negative is None or self.sampler.uses_data:
            negative = self._negative_phase(model, positive, state.sampler, generator)
        return negative, StepState(negative.state, offsets, negative)

    def _negative_phase(
        self, model: EnergyModel, positive: Configurations, state: object, generator: Generator
    ) -> NegativePhase[object]:
        """Ask the sampler; an answer that depends on the model alone is computed once for all processes."""
        if state is None:
            state = self.sampler.init(model, positive.v.shape[-2], generator=generator)

        def sample() -> NegativePhase[object]:
            return self.sampler.sample(model, state, positive, generator=generator)

        return self.processes.from_first(sample) if self.sampler.shared else sample()
