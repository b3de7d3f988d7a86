"""What the callbacks ask of a LightningModule, and how they log.

A module that trains an energy model offers all of these:

* ``training_step`` returns a dictionary with ``positive`` and ``negative`` (:class:`Configurations`),
  ``contrast`` ``(*replicas,)``, which is mean E(positive) - mean E(negative), and ``info`` (diagnostics of the
  sampler); also with ``v``, the visible states of the images, if ``positive.v`` is something else.
* ``validation_step`` returns a dictionary with ``v``, the visible states of held-out images.
* Attributes: ``model``, the model in training.

A module that trains a classifier returns ``score`` (:class:`memcomp_lightning.training.Score`) in the
dictionaries of ``training_step``, ``validation_step`` and ``test_step``.

Optional attributes:

* ``log_prefix``: begins each tag; default the class name.
* ``iteration``, ``iterations``: passes done, and planned, in this stage or layer; default the epoch and the
  trainer's ``max_epochs``.
* ``progress``: text of the progress bar.
* ``images_of(v)``: inputs that visible states stand for, for pictures.
* ``models``, ``layer``: all models that are trained, from the lowest up, and the index of ``model`` among them.
* ``sampler``: shows whether its chains persist; without one they are taken to.
* ``active_optimizer``: the optimiser that steps now; default the trainer's first.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import lightning.pytorch as pl
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from matplotlib.figure import Figure
from torch import Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.plotting.rendering import rendered


def prefix_of(module: pl.LightningModule) -> str:
    """Prefix of the module's tags."""
    return str(getattr(module, "log_prefix", type(module).__name__))


def iteration_of(module: pl.LightningModule) -> int:
    """Passes done over the training set in the module's present stage and layer."""
    return int(getattr(module, "iteration", module.current_epoch))


def model_of(module: pl.LightningModule) -> Any:
    """The energy model in training.

    Raises:
        TypeError: The module has no attribute ``model``, or it is no energy model.
    """
    model = getattr(module, "model", None)
    if not hasattr(model, "energy"):
        has = "no attribute 'model'" if model is None else f"a {type(model).__name__} as its 'model'"
        raise TypeError(
            f"{type(module).__name__} has {has}: this callback looks at the energy model in training; see "
            "memcomp_lightning.callbacks.base for the protocol."
        )
    return model


def log_scalars(
    module: pl.LightningModule, values: Mapping[str, Tensor | float], *, of_first_process: bool = False
) -> None:
    """Log means over replicas and processes at the end of an epoch.

    Args:
        module: Logs them.
        values: By name, which the module's prefix precedes.
        of_first_process: With several processes, log the values of the first alone: needed where names may
            differ from process to process, for which a mean over processes would wait forever.
    """
    prefix = prefix_of(module)
    means = {
        f"{prefix}/{name}": torch.as_tensor(value, dtype=torch.float32, device=module.device).mean()
        for name, value in values.items()
    }
    distributed = module.trainer.world_size > 1
    module.log_dict(
        means,
        on_step=False,
        on_epoch=True,
        sync_dist=distributed and not of_first_process,
        rank_zero_only=distributed and of_first_process,
        batch_size=1,
    )


def tensorboards(trainer: pl.Trainer) -> list[Any]:
    """The summary writers of all TensorBoard loggers; empty on processes other than rank 0."""
    if not trainer.is_global_zero:
        return []
    return [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]


def write_figure(trainer: pl.Trainer, module: pl.LightningModule, tag: str, figure: Figure) -> None:
    """Write a figure to every TensorBoard logger."""
    for board in tensorboards(trainer):
        tag_of_stage = f"{prefix_of(module)}/{tag}"
        board.add_image(tag_of_stage, rendered(figure), trainer.global_step, dataformats="HWC")


def require_enumerable(callback: pl.Callback, module: pl.LightningModule, max_units: int) -> None:
    """Refuse models that are too large to enumerate (``n_enumerated``): all of the module's, before training.

    Raises:
        SettingError: Naming callback and size.
    """
    for model in getattr(module, "models", None) or [model_of(module)]:
        n_units = model.n_enumerated
        name = type(callback).__name__
        require(
            n_units <= max_units,
            f"units to enumerate for {name}",
            n_units,
            f"at most {max_units} units, because all their states are enumerated",
            f"Leave {name} out, or train a model with a smaller layer.",
        )


class LastImages:
    """Collects the newest images of a pass, so that a callback can judge them at its end.

    Args:
        n: Images a replica to keep, >= 1; whole batches are kept, so there may be more.
    """

    def __init__(self, n: int) -> None:
        require_count("n_images", n)
        self.n = n
        self._batches: list[Tensor] = []

    def clear(self) -> None:
        """Forget all."""
        self._batches = []

    def add(self, v: Tensor) -> None:
        """Keep references to the images ``(*replicas, n, n_visible)`` of a batch."""
        self._batches.append(v[..., : self.n, :])
        while sum(kept.shape[-2] for kept in self._batches[1:]) >= self.n:
            self._batches.pop(0)

    def images(self) -> Tensor | None:
        """The kept images, ``(*replicas, n, n_visible)``; None before the first batch."""
        return torch.cat(self._batches, dim=-2) if self._batches else None


class EveryIterations(pl.Callback, ABC):
    """A callback that looks at the last batch of a pass, every so many passes.

    Args:
        every: Passes between two looks, >= 1; the first pass and the last one of a stage or layer are always
            looked at.
    """

    def __init__(self, every: int = 1) -> None:
        require_count("every", every)
        self.every = every
        self._outputs: Mapping[str, Any] = {}

    def is_due(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> bool:
        """Whether the present pass is looked at."""
        iteration = iteration_of(pl_module)
        n_iterations = getattr(pl_module, "iterations", trainer.max_epochs)
        return iteration % self.every == 0 or iteration + 1 == n_iterations

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Keep a reference to what ``training_step`` returned."""
        self._outputs = outputs

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Look, if it is time."""
        outputs, self._outputs = self._outputs, {}
        if self.is_due(trainer, pl_module):
            with torch.no_grad():
                self.look(trainer, pl_module, outputs)

    @abstractmethod
    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Mapping[str, Any]) -> None:
        """What a subclass does with the model and the outputs of the pass's last ``training_step``."""


def images_of_step(outputs: Mapping[str, Any], callback: pl.Callback) -> Tensor:
    """Visible states of the images of a step: ``v``, or those of ``positive``."""
    if isinstance(outputs, Mapping) and "v" in outputs:
        v: Tensor = outputs["v"]
        return v
    images: Tensor = required(outputs, "positive", callback).v
    return images


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
