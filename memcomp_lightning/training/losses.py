"""What fine-tuning minimises: a number for each image, from its class logits."""

from collections.abc import Callable

import torch.nn.functional as F
from torch import Tensor

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
