"""What the callbacks ask of a LightningModule, and how they log.

The steps of a module return a dictionary: :class:`StepOutputs` says what callbacks look at, and each needs what it
shows. A module that trains an energy model has it as the attribute ``model``.

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

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol, TypedDict, cast

import lightning.pytorch as pl
import numpy as np
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning.errors import require_count
from memcomp_lightning.models import EnergyModel
from memcomp_lightning.models.machine import require_few_bits
from memcomp_lightning.training import Score
from memcomp_lightning.types import Configurations

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


log = logging.getLogger(__name__)


class StepOutputs(TypedDict, total=False):
    """What a step returns.

    Attributes:
        positive: Data with the hidden means given them; of ``training_step``.
        negative: The negative phase; of ``training_step``.
        contrast: mean E(positive) - mean E(negative), ``(*replicas,)``; of ``training_step``.
        info: Diagnostics of the sampler; of ``training_step``, may be left out.
        v: Visible states of held-out images, of ``validation_step``; of ``training_step`` those of its images, if
            ``positive.v`` is something else.
        observed: Where ``v`` is known, a mask of its shape; None, or left out, is everywhere.
        weight: How often each image of ``v`` counts, ``(n,)``; None, or left out, is once.
        score: Of a classifier; of all steps.
    """

    positive: Configurations
    negative: Configurations
    contrast: Tensor
    info: dict[str, Tensor]
    v: Tensor
    observed: Tensor | None
    weight: Tensor | None
    score: Score


class ShownModel(EnergyModel, Protocol):
    """An energy model, with what callbacks need beyond training."""

    def mean_energy(self, configurations: Configurations) -> Tensor:
        """Weighted mean of E(v, h), ``(*replicas,)``."""

    def visible_mean(self, h: Tensor) -> Tensor:
        """E[v | h]."""


def prefix_of(module: pl.LightningModule) -> str:
    """Prefix of the module's tags."""
    return str(getattr(module, "log_prefix", type(module).__name__))


def iteration_of(module: pl.LightningModule) -> int:
    """Passes done over the training set in the module's present stage and layer."""
    return int(getattr(module, "iteration", module.current_epoch))


def model_of(module: pl.LightningModule) -> ShownModel:
    """The energy model in training; raise a TypeError if the module has none as its ``model``."""
    model = getattr(module, "model", None)
    if not hasattr(model, "energy"):
        has = "no attribute 'model'" if model is None else f"a {type(model).__name__} as its 'model'"
        raise TypeError(
            f"{type(module).__name__} has {has}: this callback looks at the energy model in training; see "
            "memcomp_lightning.callbacks.base for the protocol."
        )
    return cast(ShownModel, model)


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


def tensorboards(trainer: pl.Trainer) -> "list[SummaryWriter]":
    """The summary writers of all TensorBoard loggers; empty on processes other than rank 0."""
    if not trainer.is_global_zero:
        return []
    return [logger.experiment for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]


def write_picture(trainer: pl.Trainer, module: pl.LightningModule, tag: str, picture: NDArray[np.generic]) -> None:
    """Write a picture, ``(height, width)`` or ``(height, width, 3)``, to every TensorBoard logger."""
    axes = "HW" if picture.ndim == 2 else "HWC"
    for board in tensorboards(trainer):
        board.add_image(f"{prefix_of(module)}/{tag}", picture, trainer.global_step, dataformats=axes)


def require_enumerable(callback: pl.Callback, module: pl.LightningModule, max_units: int) -> None:
    """Raise a SettingError for models that are too large to enumerate: any of the module's, before training."""
    for model in getattr(module, "models", None) or [model_of(module)]:
        n_units, name = model.n_enumerated, type(callback).__name__
        allowed = f"at most {max_units} units, because all their states are enumerated"
        remedy = f"Leave {name} out, or train a model with a smaller layer."
        require_few_bits(f"units to enumerate for {name}", n_units, max_units, allowed, remedy)


class LastImages:
    """Collects the newest images of a pass, so that a callback can judge them at its end.

    Args:
        n: Images a replica to keep, >= 1; whole batches are kept, so there may be more.
    """

    def __init__(self, n: int) -> None:
        require_count("n_images", n)
        self.n = n
        self._batches: list[tuple[Tensor, Tensor | None, Tensor | None]] = []

    def add(self, v: Tensor, observed: Tensor | None = None, weight: Tensor | None = None) -> None:
        """Keep references to the images ``(*replicas, n, n_visible)`` of a batch, their mask and their weights."""
        mask = None if observed is None else observed[..., : self.n, :]
        counts = None if weight is None else weight[..., : self.n]
        self._batches.append((v[..., : self.n, :], mask, counts))
        while sum(kept.shape[-2] for kept, _, _ in self._batches[1:]) >= self.n:
            self._batches.pop(0)

    def images(self) -> Tensor | None:
        """The kept images, ``(*replicas, n, n_visible)``; None before the first batch."""
        return torch.cat([v for v, _, _ in self._batches], dim=-2) if self._batches else None

    def observed(self) -> Tensor | None:
        """Where they are known; None is everywhere."""
        if all(mask is None for _, mask, _ in self._batches):
            return None
        masks = [torch.ones_like(v, dtype=torch.bool) if mask is None else mask for v, mask, _ in self._batches]
        return torch.cat(masks, dim=-2)

    def weight(self) -> Tensor | None:
        """How often they count, ``(*replicas, n)``; None is once each."""
        if all(counts is None for _, _, counts in self._batches):
            return None
        weights = [v.new_ones(v.shape[:-1]) if counts is None else counts for v, _, counts in self._batches]
        return torch.cat(weights, dim=-1)


class EveryIterations(pl.Callback, ABC):
    """A callback that looks at the last batch of a pass, every so many passes.

    Args:
        every: Passes between two looks, >= 1; the first pass and the last one of a stage or layer are always
            looked at.
    """

    def __init__(self, every: int = 1) -> None:
        require_count("every", every)
        self.every = every
        self._outputs: object = None
        self._said: set[str] = set()

    def leave_out(self, why: str) -> None:
        """Say once why there is nothing to see."""
        if why not in self._said:
            self._said.add(why)
            log.info("%s is left out: %s", type(self).__name__, why)

    def is_due(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> bool:
        """Whether the present pass is looked at."""
        iteration = iteration_of(pl_module)
        n_iterations = getattr(pl_module, "iterations", trainer.max_epochs)
        return iteration % self.every == 0 or iteration + 1 == n_iterations

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Keep a reference to what ``training_step`` returned."""
        self._outputs = outputs

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Look, if it is time."""
        outputs, self._outputs = self._outputs, None
        if self.is_due(trainer, pl_module):
            with torch.no_grad():
                self.look(trainer, pl_module, outputs)

    @abstractmethod
    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """What a subclass does with the model and the outputs of the pass's last ``training_step``."""


def images_of_step(outputs: object, callback: pl.Callback) -> Tensor:
    """Visible states of the images of a step: ``v``, or those of ``positive``."""
    if isinstance(outputs, Mapping) and "v" in outputs:
        return required(outputs, callback, "v")["v"]
    return required(outputs, callback, "positive")["positive"].v


def mask_of_step(outputs: object) -> Tensor | None:
    """Where the images of a step are known; None is everywhere."""
    return cast(StepOutputs, outputs).get("observed") if isinstance(outputs, Mapping) else None


def weight_of_step(outputs: object) -> Tensor | None:
    """How often the images of a step count; None is once each."""
    return cast(StepOutputs, outputs).get("weight") if isinstance(outputs, Mapping) else None


def required(outputs: object, callback: pl.Callback, *keys: str) -> StepOutputs:
    """Return what a step returned; raise a TypeError if it is no dictionary or lacks one of the keys."""
    for key in keys:
        if not isinstance(outputs, Mapping) or key not in outputs:
            raise TypeError(
                f"{type(callback).__name__} needs {key!r} in the dictionary that the module's step returns; see "
                "memcomp_lightning.callbacks.base for the protocol."
            )
    return cast(StepOutputs, outputs)
