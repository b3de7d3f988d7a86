"""The up-down algorithm: wake-sleep training of a deep belief network as a generative model.

Its RBM on top follows a contrast, as in pretraining; the directed layers below learn to make what the recognition
model finds in the data (*wake*), and the recognition model to find what the directed layers make (*sleep*).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.ambient import with_gradient
from memcomp_lightning.errors import require, require_choice, require_count
from memcomp_lightning.models.base import Readout
from memcomp_lightning.models.conditional import Conditional
from memcomp_lightning.models.generative import GenerativeDBN
from memcomp_lightning.objective import shares, weighted
from memcomp_lightning.products import n_weights, quick_products
from memcomp_lightning.samplers import CD, positive_phase
from memcomp_lightning.training.diverged import require_finite
from memcomp_lightning.training.given import Given, begin_epoch, updates_of
from memcomp_lightning.training.schedules import OptimizerFactory, Schedule, begin_pass
from memcomp_lightning.training.step import EnergyStep, StepState
from memcomp_lightning.types import Batch

if TYPE_CHECKING:
    from memcomp_lightning.training.loops import Batches

STREAMS = ("wake", "negative_phase", "sleep")
"""Names of the random streams."""


class UpDownLosses(NamedTuple):
    """What a batch costs, in nats an image, ``(*replicas,)`` each.

    Attributes:
        wake: -log p of the data and of the layers below the top given those above, as the recognition model draws
            them.
        contrast: Mean energy of the top RBM's positive phase less that of its negative phase.
        sleep: -log q of what the directed layers were made from.
    """

    wake: Tensor
    contrast: Tensor
    sleep: Tensor


@dataclass(frozen=True, kw_only=True)
class UpDownStep:
    r"""Computes the gradients of an update, batch by batch.

    (Hinton, Osindero & Teh 2006, section 5 and appendix B.) Of images v and draws :math:`h \sim q(h | v)` it
    follows

    .. math::

        -\log p(v | h_1) - \log p(h_1 | h_2) - \ldots \quad \text{in the directed layers,}

    the top RBM's contrast with positive phase :math:`(h_{L-1}, label)`, and, of what the directed layers make of
    the negative phase of the top RBM,

    .. math:: -\log q(h_1 | v) - \log q(h_2 | h_1) - \ldots \quad \text{in the recognition model.}

    Each of the three leaves the parameters of the other two alone.

    Attributes:
        top: The update of the top RBM. A sampler that starts at the data, as CD, makes the wake-sleep algorithm
            *contrastive*: the sleep phase begins near the data. One with chains of its own makes it the plain one.
        visible: What the recognition model sees in its sleep: means, as in the paper, or samples, as the objective
            has it.
    """

    top: EnergyStep = field(default_factory=lambda: EnergyStep(sampler=CD(k=3)))
    visible: Readout = "mean"

    def __post_init__(self) -> None:
        require_choice("visible", self.visible, ("mean", "sample"))
        signed = getattr(self.top.sampler, "signed_weights", False)
        allowed = "a sampler whose states are draws, as the sleep phase begins at them"
        require(not signed, "sampler", type(self.top.sampler).__name__, allowed)

    def add_gradient(
        self, model: GenerativeDBN, batch: Batch, state: StepState, *, streams: Mapping[str, Generator]
    ) -> tuple[UpDownLosses, StepState]:
        """Add the gradients of a batch to those of the parameters.

        Args:
            model: The model.
            batch: Images without gaps, and their labels if the model has labels.
            state: What the call before returned, ``after_update()`` where the update was complete.
            streams: Generators by the names of :data:`STREAMS`.
        """
        require(batch.observed is None, "missing values", "in the data of up-down training", "none")
        awake = model.up(batch.v, generator=streams["wake"])
        positive = weighted(positive_phase(model.top, model.with_label(awake[-1], batch.label)), batch.weight)
        share = batch.share * shares(positive)
        of_wake = [layer.add_gradient(x, h, share) for layer, (x, h) in _layers(model.downward, awake)]
        contrast, negative, state = self.top.add_gradient(
            model.top, positive, state, share=batch.share, generator=streams["negative_phase"]
        )
        dreamt = negative.configurations
        x = model.top.visible.values_of(dreamt.v, generator=streams["sleep"])
        asleep = model.down(x, visible=self.visible, generator=streams["sleep"])
        share = batch.share * shares(dreamt)
        of_sleep = [layer.add_gradient(h, x, share) for layer, (x, h) in _layers(model.upward, asleep)]
        assert contrast is not None
        zero = torch.zeros_like(contrast)
        wake, sleep = (sum(losses, zero) / batch.share for losses in (of_wake, of_sleep))
        return UpDownLosses(wake, contrast, sleep), state


def _layers(
    layers: Sequence[Conditional], states: Sequence[Tensor]
) -> Iterator[tuple[Conditional, tuple[Tensor, Tensor]]]:
    """Each layer with the states below and above it."""
    return zip(layers, pairwise(states), strict=True)


def up_down(
    model: GenerativeDBN,
    batches: "Batches | Iterable[Given] | Tensor",
    *,
    iterations: int,
    optimizer: OptimizerFactory,
    step: UpDownStep | None = None,
    schedules: Sequence[Schedule] = (),
    seed: int = 0,
) -> Iterator[UpDownLosses]:
    """Train a model in place; yield the mean losses of each pass once it is done.

    The bare loop of :class:`memcomp_lightning.modules.UpDown`: update for update, and draw for draw on the CPU.

    Args:
        model: The model.
        batches: Rows with the model's replica axes and, if it has them, labels.
        iterations: Passes over the training set, >= 1.
        optimizer: Builds the optimiser, element-wise, so that replicas stay independent.
        step: Settings of an update; None are those of the paper.
        schedules: Change the optimiser from pass to pass.
        seed: Of the random streams.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    require_count("iterations", iterations)
    step = UpDownStep() if step is None else step
    device = model.top.b.device
    streams = rng.streams(seed, STREAMS, device=device)
    made, state = optimizer(model.parameters()), StepState()
    for epoch in range(iterations):
        begin_epoch(batches, epoch)
        begin_pass(schedules, made, epoch)
        found: list[Tensor] = []
        n_updates = 0
        with with_gradient():
            for batch in updates_of(batches, model.visible):
                with quick_products(batch.v.shape[-2] * n_weights(model)):
                    losses, state = step.add_gradient(model, batch, state, streams=streams)
                found.append(torch.stack(losses) * batch.share)
                if batch.closes_step:
                    n_updates += 1
                    made.step()
                    model.top.project()
                    made.zero_grad()
                    state = state.after_update()
        require_finite(model, "up-down training")
        yield UpDownLosses(*torch.stack(found).sum(0) / n_updates)
