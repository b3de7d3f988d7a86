"""Early stopping: of all passes the weights of the best, and when to wait no longer for a better one."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from memcomp_lightning.errors import require_count
from memcomp_lightning.training.score import Score

JUDGED_BY: dict[str, Callable[[Score], Tensor]] = {
    "accuracy": lambda score: score.accuracy,
    "loss": lambda score: -score.mean_loss,
}
"""What is maximised on held-out data, by the names that ``finetune.best_by`` takes, ``(*replicas,)``."""


class BestPass:
    """Keeps, replica by replica, the weights of the pass with the highest value; of equal passes the first.

    A replica that has waited as long as it may takes no weights any more, so that it ends as it would alone.

    Args:
        patience: Passes in a row without a higher value after which a replica is done, >= 1; None never is.
        tolerance: By how much a value must be higher for the waiting to begin anew, >= 0.

    Attributes:
        value: The highest so far, ``(*replicas,)``; None before the first pass.
        waited: Passes since it rose, ``(*replicas,)`` int64.
        weights: Its tensors by name, which begin with the axes of the value.
    """

    def __init__(self, *, patience: int | None = None, tolerance: float = 0.0) -> None:
        if patience is not None:
            require_count("patience", patience)
        self.patience, self.tolerance = patience, tolerance
        self.value: Tensor | None = None
        self.waited: Tensor | None = None
        self.weights: dict[str, Tensor] = {}

    @property
    def over(self) -> bool:
        """Whether no replica waits for a better pass any more."""
        return self.patience is not None and self.waited is not None and bool((self.waited >= self.patience).all())

    def state_dict(self) -> dict[str, Any]:
        """All that it has kept, for checkpoints."""
        return {"value": self.value, "waited": self.waited, "weights": self.weights}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Inverse of :meth:`state_dict`."""
        for name, value in state_dict.items():
            setattr(self, name, value)

    @torch.no_grad()
    def offer(self, value: Tensor, weights: Mapping[str, Tensor]) -> None:
        """Take the weights of the replicas that are better than ever; they are copied.

        Args:
            value: What is maximised, ``(*replicas,)``.
            weights: Tensors by name after this pass.
        """
        better, risen = torch.ones_like(value, dtype=torch.bool), torch.ones_like(value, dtype=torch.bool)
        waited = torch.zeros_like(value, dtype=torch.long)
        if self.value is not None and self.waited is not None:
            so_far, waited = self.value.to(value), self.waited.to(value.device)
            better, risen = value > so_far, value > so_far + self.tolerance
            if self.patience is not None:
                waits = waited < self.patience
                better, risen = better & waits, risen & waits
            value = torch.where(better, value, so_far)
        self.value, self.waited = value, torch.where(risen, 0, waited + 1)
        for name, now in weights.items():
            if not now.is_floating_point():  # indices, which no replica has of its own
                self.weights[name] = now.clone()
                continue
            own = better.to(now.device).view((*better.shape, *[1] * (now.ndim - better.ndim)))
            self.weights[name] = torch.where(own, now, self.weights.get(name, now).to(now))
