"""Supervised training of any network on the replica axis."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.optim import Optimizer

from memcomp_lightning import defaults
from memcomp_lightning.ambient import plain, with_gradient
from memcomp_lightning.errors import require_choice, require_count
from memcomp_lightning.modules.losses import LOSSES, Loss, cross_entropy
from memcomp_lightning.modules.stage import FINETUNING_SGD, OptimizerFactory, StageModule
from memcomp_lightning.types import Batch


class Score(NamedTuple):
    """Sums over images, so that chunks add up.

    Attributes:
        loss: Sum of the losses, ``(*replicas,)``.
        n_correct: Images whose largest logit is their label's, ``(*replicas,)``.
        n_images: Images a replica.
    """

    loss: Tensor
    n_correct: Tensor
    n_images: int

    def __add__(self, other: object) -> "Score":
        """Score of both sets of images together."""
        if not isinstance(other, Score):
            return NotImplemented
        return Score(self.loss + other.loss, self.n_correct + other.n_correct, self.n_images + other.n_images)

    @property
    def accuracy(self) -> Tensor:
        """Share of images classified correctly, ``(*replicas,)`` in [0, 1]."""
        return self.n_correct.float() / self.n_images

    @property
    def mean_loss(self) -> Tensor:
        """Mean loss, ``(*replicas,)``."""
        return self.loss / self.n_images


def score(logits: Tensor, label: Tensor, loss: Loss = cross_entropy) -> Score:
    """Return the score of logits ``(*replicas, n, n_classes)`` against labels ``(*replicas, n)``."""
    n_correct = (logits.argmax(-1) == label).sum(-1)
    return Score(loss(logits, label).sum(-1), n_correct, label.shape[-1])


@torch.no_grad()
def evaluate(network: nn.Module, batches: Any, loss: Loss = cross_entropy) -> Score:
    """Return the score of a network in evaluation mode over an iterable of :class:`Batch`."""
    was_training = network.training
    network.eval()
    like = next(network.parameters())
    scores = [score(network(batch.v.to(like)), batch.label.to(like.device), loss) for batch in batches]
    network.train(was_training)
    return sum(scores[1:], start=scores[0])


class Classifier(StageModule):
    """Minimise the loss of a network by back-propagation.

    Args:
        network: Maps inputs ``(*replicas, n, n_visible)`` to logits ``(*replicas, n, n_classes)``.
        iterations: Passes over the training set, >= 1.
        optimizer: Builds the optimiser from the network's parameters.
        loss: "cross_entropy", or "squared_error" of sigmoid outputs.
        seed: Seed of the random streams.

    Raises:
        SettingError: ``iterations`` or ``loss`` out of range.
    """

    stage = "finetune"

    def __init__(
        self,
        network: nn.Module,
        *,
        iterations: int = defaults.FINETUNING_PASSES,
        optimizer: OptimizerFactory = FINETUNING_SGD,
        loss: str = "cross_entropy",
        seed: int = 0,
    ) -> None:
        require_count("finetune.iterations", iterations)
        require_choice("finetune.loss", loss, tuple(LOSSES))
        super().__init__(iterations=iterations, optimizer=optimizer, seed=seed)
        self.network = network
        self.loss = LOSSES[loss]

    def forward(self, v: Tensor) -> Tensor:
        """Class logits."""
        logits: Tensor = self.network(v)
        return logits

    def configure_optimizers(self) -> Optimizer:
        """One optimiser for all parameters."""
        return self.make_optimizer(self.network.parameters())

    @with_gradient()
    def training_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        """Follow the gradient of the mean loss; replicas add up and stay independent.

        Returns:
            ``loss`` (scalar) and ``score``.
        """
        logits, label = self(plain(batch.v)), plain(batch.label)
        sums = score(logits, label, self.loss)
        mean_loss = sums.mean_loss
        if batch.weight is not None:
            mean_loss = (self.loss(logits, label) * batch.weight).sum(-1) / batch.weight.sum(-1)
        loss = batch.share * mean_loss.sum()
        self.update(loss, closes_step=batch.closes_step)
        return {"loss": loss.detach(), "score": Score(sums.loss.detach(), sums.n_correct, sums.n_images)}

    def validation_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        """Return the ``score`` of held-out images."""
        return {"score": score(self(batch.v), batch.label, self.loss)}

    def test_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        """Return the ``score`` of test images."""
        return self.validation_step(batch, batch_idx)
