"""How many images a network classifies correctly, and its mean loss on them."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor, nn

from memcomp_lightning.errors import require
from memcomp_lightning.training.filling import Filling
from memcomp_lightning.training.losses import Loss, cross_entropy
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
    return score_of(loss(logits, label), logits, label)


def score_of(losses: Tensor, logits: Tensor, label: Tensor) -> Score:
    """Return the score of logits whose losses, ``(*replicas, n)``, are known already."""
    return Score(losses.sum(-1), (logits.argmax(-1) == label).sum(-1), label.shape[-1])


@torch.no_grad()
def evaluate(
    network: nn.Module, batches: Iterable[Batch], loss: Loss = cross_entropy, *, filling: Filling | None = None
) -> Score:
    """Return the score of a network in evaluation mode over an iterable of :class:`Batch`.

    Args:
        network: Maps inputs to logits.
        batches: What it is judged by.
        loss: Of each image.
        filling: Draws what is missing; None refuses missing values.
    """
    was_training = network.training
    network.eval()
    like = next(network.parameters())
    scores = []
    for number, batch in enumerate(batches):
        observed = None if batch.observed is None else batch.observed.to(like.device)
        there = batch._replace(v=batch.v.to(like), label=batch.label.to(like.device), observed=observed)
        scores.append(judged(network, there, loss, filling, number))
    network.train(was_training)
    return sum(scores[1:], start=scores[0])


def judged(network: nn.Module, batch: Batch, loss: Loss, filling: Filling | None, number: int) -> Score:
    """The score of a batch by its number; with ``filling`` it may have missing values."""
    if filling is not None:
        return score(filling.judged(network, batch, number, loss), batch.label, loss)
    require_complete(batch)
    return score(network(batch.v), batch.label, loss)


def require_complete(batch: Batch) -> None:
    """Raise a SettingError where values are missing, for which a classifier has no input."""
    require(batch.observed is None, "missing values", "in the data of a classifier", NO_GAPS, FILL_IN)


NO_GAPS = "none, but for a DBN that was pretrained on these data in the same run and draws them"
FILL_IN = (
    "Fill them in first, by memcomp-impute with a model of the data, or pretrain alone: finetune.iterations=0."
)
