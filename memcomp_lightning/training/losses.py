"""What fine-tuning minimises: a number for each image, from its class logits."""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from memcomp_lightning.errors import require

Loss = Callable[[Tensor, Tensor], Tensor]
"""Maps logits ``(*replicas, n, n_classes)`` and labels ``(*replicas, n)`` to ``(*replicas, n)``."""


def cross_entropy(logits: Tensor, label: Tensor) -> Tensor:
    """``-log softmax(logits)[label]``, in nats."""
    # torch's cross-entropy wants the classes on the second axis.
    return F.cross_entropy(logits.flatten(0, -2), label.flatten(), reduction="none").view(label.shape)


def squared_error(logits: Tensor, label: Tensor) -> Tensor:
    r"""``\sum_k (sigmoid(z_k) - y_k)^2 / 2`` with one-hot y: the loss of a layer of sigmoid outputs."""
    target = F.one_hot(label, logits.shape[-1]).to(logits)
    return (logits.sigmoid() - target).square().sum(-1) / 2


LOSSES: dict[str, Loss] = {"cross_entropy": cross_entropy, "squared_error": squared_error}
"""By the names that ``finetune.loss`` takes."""


class ClassWeighted:
    """A loss in which each class counts more or less: ``weight[label]`` times that of the image.

    The mean over images divides by their number, whatever their classes, so that the losses of parts add up.

    Args:
        loss: That of each image.
        weight: Of each class, > 0, ``(n_classes,)``.
    """

    def __init__(self, loss: Loss, weight: Tensor) -> None:
        fits = weight.ndim == 1 and bool((weight > 0).all() & weight.isfinite().all())
        require(fits, "class weights", weight.tolist(), "a list of numbers > 0, one for each class")
        self.loss, self._weight = loss, weight

    def __call__(self, logits: Tensor, label: Tensor) -> Tensor:
        """The weighted losses of the images."""
        return self.loss(logits, label) * self.of(label).to(logits.dtype)

    def of(self, label: Tensor) -> Tensor:
        """Weights of the images of these labels, of their shape."""
        self._weight = self._weight.to(label.device)  # once: a copy in each update would wait for the device
        return self._weight[label]


def balanced(totals: Tensor) -> Tensor:
    """Weights with which each class counts alike, and an image of the training set 1 on average.

    Args:
        totals: Training images of each class, ``(n_classes,)``; a class without any has the weight 1.

    >>> balanced(torch.tensor([30, 10])).tolist()
    [0.6666666865348816, 2.0]
    """
    share = totals.double() * (totals > 0).sum() / totals.sum()
    return torch.where(totals > 0, 1 / share, 1.0).float()
