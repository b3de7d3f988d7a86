"""Inputs of a classifier where values are missing: draws from a model of the data, never a mean in secret."""

import copy
from typing import cast

import torch
from torch import Generator, Tensor, nn

from memcomp_lightning import rng
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.samplers import ClampedGibbs
from memcomp_lightning.training.losses import ClassWeighted, Loss, squared_error
from memcomp_lightning.types import Batch

N_DRAWS = 10
"""For each row that is judged."""


class Filling:
    r"""Fills gaps by draws of a trained model, which is copied and stays as it is.

    They come after ten sweeps from a random start with the known values clamped: quick enough for each update,
    and near to p(missing | observed) where these sweeps mix. ``memcomp-score`` takes as long as it needs.

    A network that is trained sees a draw of its own each time. Rows that are judged have the mean of the class
    probabilities over :data:`N_DRAWS` draws, which estimates :math:`\sum p(class | v) p(missing | observed)`.

    Args:
        model: Of the data.
        seed: Of the draws for rows that are judged: the same rows in the same batch have the same draws.
    """

    def __init__(self, model: EnergyModel, *, seed: int = 0) -> None:
        self._model = copy.deepcopy(model)
        self._seed = seed

    @torch.no_grad()
    def complete(self, batch: Batch, generator: Generator) -> Batch:
        """The batch with draws where values are missing."""
        if batch.observed is None:
            return batch
        model = cast(EnergyModel, cast(nn.Module, self._model).to(batch.v))
        found = ClampedGibbs().sample(model, batch.v, observed=batch.observed, generator=generator)
        return batch._replace(v=found.configurations.v, observed=None)

    @torch.no_grad()
    def judged(self, network: nn.Module, batch: Batch, number: int, loss: Loss) -> Tensor:
        """Logits of the mean class probabilities, ``(*replicas, n, n_classes)``.

        Args:
            network: In evaluation mode.
            batch: What is judged.
            number: Of the batch, which is a part of its seed.
            loss: What the network is trained by; with squared errors its outputs are sigmoid.
        """
        if batch.observed is None:
            return cast(Tensor, network(batch.v))
        generator = rng.stream(self._seed, "missing values, judged", number)
        logits = torch.stack([network(self.complete(batch, generator).v) for _ in range(N_DRAWS)])
        if (loss.loss if isinstance(loss, ClassWeighted) else loss) is squared_error:
            return torch.logit(logits.sigmoid().mean(0), eps=1e-6)
        return logits.log_softmax(-1).exp().mean(0).log()
