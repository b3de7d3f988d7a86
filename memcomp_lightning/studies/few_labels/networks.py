"""Networks that are trained by back-propagation: what they start from, and their training side by side."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import torch
from torch import nn

from memcomp_lightning import rng
from memcomp_lightning.defaults import FINETUNING_MOMENTUM
from memcomp_lightning.models import BatchNormReluNetwork, Linear, Normal, Randomiser, Xavier, stacked
from memcomp_lightning.studies.few_labels.data import Sets, batches
from memcomp_lightning.studies.few_labels.learner import Context, Point, point_of
from memcomp_lightning.studies.search import Setting
from memcomp_lightning.training import DivergedError, finetune


class Start(Protocol):
    """What a network is before it sees a label."""

    def network(self, context: Context, n_classes: int) -> nn.Module:
        """A new one."""


@dataclass(frozen=True, kw_only=True)
class Pretrained:
    """The DBN of a method's pretraining, or one of small random weights, with an output layer.

    Attributes:
        change: What is done to its weights, of the control group; None is nothing.
    """

    change: Randomiser | None = None

    def network(self, context: Context, n_classes: int) -> nn.Module:
        """DBN and output layer, whose weights are N(0, 0.01^2)."""
        dbn = context.dbn()
        if self.change is not None:
            self.change(dbn, generator=rng.stream(context.seed, "between stages"))
        own = rng.stream(context.seed, "output weights")
        output = Linear(dbn.n_hidden, n_classes, weight_init=Normal(std=0.01), generator=own)
        return nn.Sequential(dbn, output)


@dataclass(frozen=True, kw_only=True)
class BatchNormRelu:
    """Batch normalisation and ReLU in layers of the same size, Xavier weights."""

    def network(self, context: Context, n_classes: int) -> nn.Module:
        """A new one."""
        sizes, own = [rbm.n_hidden for rbm in context.blank], rng.stream(context.seed, "weights")
        return BatchNormReluNetwork(
            context.blank.n_visible, sizes, n_classes, weight_init=Xavier(gain=1.0), generator=own
        )


@dataclass(frozen=True, kw_only=True)
class Network:
    """Back-propagation from a start: stochastic gradient descent with momentum, weight decay and dropout.

    A setting has a rate, and may have weight_decay and dropout. All sets are trained as one tensor program.
    """

    start: Start

    def learn(self, context: Context, sets: Sets, setting: Setting, passes: Sequence[int] | None) -> list[Point]:
        """See :class:`Learner`."""
        found = []
        with contextlib.suppress(DivergedError):  # what it had reached before counts
            for done, network in self.fit(context, sets, setting, passes):
                found.append(point_of(done, network, sets))
        return found

    def fit(
        self, context: Context, sets: Sets, setting: Setting, passes: Sequence[int] | None
    ) -> Iterator[tuple[int, nn.Module]]:
        """Train; yield the networks side by side after each of the passes."""
        n = sets.at.shape[-1]
        network = stacked([self.start.network(context, sets.n_classes)] * sets.n_sets, ())
        points = context.lengths.points(n) if passes is None else tuple(passes)
        size = context.lengths.batch_size(n)
        yield from trained(network, sets, setting, points, size)


def trained(
    network: nn.Module,
    sets: Sets,
    setting: Setting,
    points: Sequence[int],
    size: int,
    *,
    others: tuple[torch.Tensor, torch.Tensor] | None = None,
) -> Iterator[tuple[int, nn.Module]]:
    """Train networks side by side in place; yield them after each of some passes.

    ``others`` are places and classes of rows to learn from in the place of the labelled ones.
    """
    optimizer = partial(
        torch.optim.SGD,
        lr=setting["rate"],
        momentum=FINETUNING_MOMENTUM,
        weight_decay=setting.get("weight_decay", 0.0),
        fused=True,  # few images an update: its step is as much work as its gradient
    )
    at, label = (sets.at, sets.label) if others is None else others
    passes = finetune(
        network,
        batches(sets.rows, at, label, size, sets.seed),
        iterations=points[-1],
        optimizer=optimizer,
        dropout=setting.get("dropout", 0.0),
        seeds=(sets.seed,),
    )
    for done in passes:
        if done in points:
            yield done, network
