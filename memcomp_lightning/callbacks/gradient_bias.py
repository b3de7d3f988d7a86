"""How far the sampler's gradient is from the exact one."""

import copy

import lightning.pytorch as pl
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.base import EveryIterations, log_scalars, model_of, require_enumerable, required
from memcomp_lightning.models import EnergyModel
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import Exact
from memcomp_lightning.types import Configurations, NoState

MAX_UNITS = 16
"""Largest smaller layer: 2^16 configurations are held at once."""


class GradientBias(EveryIterations):
    """Shows how far the sampler's gradient is from the exact one, for the last batch of a pass.

    Logs ``gradient_bias/cosine``, which is ``g.g* / |g||g*|``, and ``gradient_bias/relative_error``, which is
    ``|g - g*| / |g*|``: g follows from the sampler's negative phase, g* from the exact expectation. Weights and
    biases count together; values are means over replicas. The noise of one batch's chains is in them, too: it
    falls with the number of chains, the bias of the sampler does not. Both are plain gradients, also where
    training follows another one (centred, with weight decay), at the parameters that the sampler met, before the
    step. They are taken on a copy, so that ``grad`` of the model is not touched.

    All states of the smaller layer are held at once: for each replica 2^(its units) rows, each as long as the
    larger layer.

    Raises:
        SettingError: At the start of training, if a smaller layer has more than 16 units.
    """

    def __init__(self, every: int = 20) -> None:
        super().__init__(every)
        self._before: EnergyModel | None = None

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Refuse models too large to enumerate."""
        require_enumerable(self, pl_module, MAX_UNITS)

    def on_train_batch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule, *_: object) -> None:
        """Keep the model as the sampler meets it."""
        if trainer.is_last_batch and self.is_due(trainer, pl_module):
            self._before = copy.deepcopy(model_of(pl_module))

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Compare both gradients."""
        model, self._before = self._before, None
        if model is None:
            return
        step = required(outputs, self, "positive", "negative")
        positive, negative = step["positive"], step["negative"]
        # Enumeration draws nothing; the protocol of samplers asks for a stream.
        generator = rng.stream(0, "gradient_bias")
        exact = Exact(max_units=MAX_UNITS).sample(model, NoState(), positive, generator=generator).configurations
        cosine, error = compared(gradient(model, positive, negative), gradient(model, positive, exact))
        log_scalars(pl_module, {"gradient_bias/cosine": cosine, "gradient_bias/relative_error": error})


def compared(found: Tensor, wanted: Tensor) -> tuple[Tensor, Tensor]:
    """Cosine of two gradients and relative error of the first, ``(*replicas,)`` each."""
    return torch.cosine_similarity(found, wanted, dim=-1), (found - wanted).norm(dim=-1) / wanted.norm(dim=-1)


def gradient(model: EnergyModel, positive: Configurations, negative: Configurations) -> Tensor:
    """Gradient of the contrast by all parameters end to end, ``(*replicas, n_parameters)``."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    with torch.enable_grad():
        gradients = torch.autograd.grad(contrast(model, positive, negative).sum(), parameters)
    return torch.cat([part.flatten(len(model.replicas)) for part in gradients], dim=-1)
