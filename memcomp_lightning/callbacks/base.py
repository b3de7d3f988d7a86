"""What the callbacks ask of a LightningModule, and how they log.

A module that trains an energy model offers both of these:

* ``training_step`` returns a dictionary with ``positive`` and ``negative`` (:class:`Configurations`),
  ``contrast`` ``(*replicas,)`` and ``info`` (diagnostics of the sampler); ``validation_step`` returns one
  with ``v``, the visible states of held-out images.
* Attributes: ``rbm``, the model in training.

A module that trains a classifier returns ``score`` (:class:`memcomp_lightning.modules.Score`) in the
dictionaries of ``training_step``, ``validation_step`` and ``test_step``.

Optional attributes: ``log_prefix`` (prefix of tags, default the class name), ``iteration`` (default the
epoch), ``progress`` (text of the progress bar), ``images_of(v)`` (inputs that visible states stand for),
``dbn`` and ``layer`` (the stack that ``rbm`` is part of, for receptive fields), ``active_optimizer``.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from memcomp_lightning.errors import require_count


def prefix_of(module: pl.LightningModule) -> str:
    """Prefix of the module's tags."""
    return str(getattr(module, "log_prefix", type(module).__name__))


def iteration_of(module: pl.LightningModule) -> int:
    """Passes done over the training set in the module's present stage and layer."""
    return int(getattr(module, "iteration", module.current_epoch))


def rbm_of(module: pl.LightningModule) -> Any:
    """The energy model in training.

    Raises:
        TypeError: The module has no attribute ``rbm``.
    """
    if not hasattr(module, "rbm"):
        raise TypeError(
            f"{type(module).__name__} has no attribute 'rbm', the energy model in training, which this callback "
            "looks at; see memcomp_lightning.callbacks.base for the protocol."
        )
    return module.rbm


def log_scalars(module: pl.LightningModule, values: Mapping[str, Tensor | float]) -> None:
    """Log means over replicas and processes at the end of an epoch."""
    prefix = prefix_of(module)
    means = {
        f"{prefix}/{name}": torch.as_tensor(value, dtype=torch.float32, device=module.device).mean()
        for name, value in values.items()
    }
    distributed = module.trainer.world_size > 1
    module.log_dict(means, on_step=False, on_epoch=True, sync_dist=distributed, batch_size=1)


def tensorboards(trainer: pl.Trainer) -> list[Any]:
    """The summary writers of all TensorBoard loggers; empty on processes other than rank 0."""
    if not trainer.is_global_zero:
        return []
    return [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]


class EveryIterations(pl.Callback, ABC):
    """A callback that looks at the last batch of a pass, every so many passes.

    Args:
        every: Passes between two looks, >= 1; the first pass is always looked at.
    """

    def __init__(self, every: int = 1) -> None:
        require_count("every", every)
        self.every = every
        self._outputs: Mapping[str, Any] = {}

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Keep a reference to what ``training_step`` returned."""
        self._outputs = outputs

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Look, if it is time."""
        outputs, self._outputs = self._outputs, {}
        if iteration_of(pl_module) % self.every == 0:
            with torch.no_grad():
                self.look(trainer, pl_module, outputs)

    @abstractmethod
    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Mapping[str, Any]) -> None:
        """What a subclass does with the model and the outputs of the pass's last ``training_step``."""


def required(outputs: Mapping[str, Any], key: str, callback: pl.Callback) -> Any:
    """Return ``outputs[key]``.

    Raises:
        TypeError: ``training_step`` or ``validation_step`` does not return it.
    """
    if not isinstance(outputs, Mapping) or key not in outputs:
        raise TypeError(
            f"{type(callback).__name__} needs {key!r} in the dictionary that the module's step returns; see "
            "memcomp_lightning.callbacks.base for the protocol."
        )
    return outputs[key]
