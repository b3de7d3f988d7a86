"""What a way of pretraining says: a list of phases, each with one energy model.

A way of your own is a class with the attributes of :class:`PretrainingStage`; every loop trains it:
:class:`memcomp_lightning.modules.EnergyPretraining` and :func:`memcomp_lightning.training.pretrain`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Generator, Tensor, nn

from memcomp_lightning import rng
from memcomp_lightning.errors import require_parts
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.samplers import NegativePhaseSampler, PositivePhase
from memcomp_lightning.samplers.base import require_state
from memcomp_lightning.types import Batch


def unchanged(v: Tensor) -> Tensor:
    """Images where the model's visible units are the images' pixels."""
    return v


@dataclass(frozen=True, kw_only=True)
class Phase:
    """The training of one energy model.

    Attributes:
        name: What it is called in tables: "layer 1".
        tag: What follows the name of the stage in the tags of TensorBoard: "layer1"; nothing if empty.
        model: The model in training.
        positive: Maps visible states ``(*replicas, n, n_visible)``, a mask of those that are observed (None is
            all) and a random stream to the positive phase.
        visible_of: Maps images to visible states.
        images_of: Maps visible states to images, for pictures.
        complete: Draws what is missing of images, ``(v, observed, generator)``, before ``visible_of``; None where
            the positive phase knows the mask.
    """

    name: str
    tag: str
    model: EnergyModel
    positive: Callable[[Tensor, Tensor | None, Generator], PositivePhase]
    visible_of: Callable[[Tensor], Tensor] = unchanged
    images_of: Callable[[Tensor], Tensor] = unchanged
    complete: Callable[[Tensor, Tensor, Generator], Tensor] | None = None

    def positive_of(self, batch: Batch, generator: Generator) -> tuple[Tensor, PositivePhase]:
        """What the model sees of a batch, and its positive phase."""
        v, observed = self.seen_of(batch, generator)
        return v, self.positive(v, observed, generator)

    def seen_of(self, batch: Batch, generator: Generator) -> tuple[Tensor, Tensor | None]:
        """What the model sees of a batch, and where it is known; None is everywhere."""
        v, observed = batch.v, batch.observed
        if observed is not None and self.complete is not None:
            v, observed = self.complete(v, observed, generator), None
        return self.visible_of(v), observed


class PretrainingStage(Protocol):
    """A way of pretraining."""

    @property
    def network(self) -> nn.Module:
        """What is pretrained, and fine-tuned afterwards."""

    @property
    def phases(self) -> Sequence[Phase]:
        """The models in the order of their training."""

    def hand_over(self) -> None:
        """Give the network its weights, after each pass; nothing where the models are parts of it."""


def check_stage(stage: PretrainingStage, sampler: NegativePhaseSampler[Any, Any], seed: int) -> None:
    """Raise a SettingError for what is no stage, and models that a sampler cannot handle, before training."""
    require_parts("stage", stage, "way of pretraining", ("network", "phases", "hand_over"))
    for phase in stage.phases:
        require_state(sampler.init(phase.model, 1, generator=rng.stream(seed, "check")))
