"""Early stopping in hindsight: of all passes, the weights of the best."""

from collections.abc import Mapping

import torch
from torch import Tensor


class BestPass:
    """Keeps, replica by replica, the weights of the pass with the highest accuracy; of equal passes the first.

    Attributes:
        accuracy: The highest so far, ``(*replicas,)``; None before the first pass.
        weights: Its tensors by name, which begin with the axes of the accuracy.
    """

    def __init__(self) -> None:
        self.accuracy: Tensor | None = None
        self.weights: dict[str, Tensor] = {}

    @torch.no_grad()
    def offer(self, accuracy: Tensor, weights: Mapping[str, Tensor]) -> None:
        """Take the weights of the replicas that are better than ever; they are copied."""
        better = torch.ones_like(accuracy, dtype=torch.bool)
        if self.accuracy is not None:
            so_far = self.accuracy.to(accuracy)
            better = accuracy > so_far
            accuracy = torch.where(better, accuracy, so_far)
        self.accuracy = accuracy
        for name, now in weights.items():
            if not now.is_floating_point():  # indices, which no replica has of its own
                self.weights[name] = now.clone()
                continue
            own = better.view((*better.shape, *[1] * (now.ndim - better.ndim)))
            self.weights[name] = torch.where(own, now, self.weights.get(name, now).to(now))
