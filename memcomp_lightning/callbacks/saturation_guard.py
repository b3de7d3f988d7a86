"""Stops training that has gone out of hand, with the last good weights on disk."""

import logging
from contextlib import suppress
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch import Tensor

from memcomp_lightning.callbacks.base import iteration_of, prefix_of
from memcomp_lightning.errors import SettingError, require, require_count
from memcomp_lightning.models.units import Units
from memcomp_lightning.modules.weights import write_tensors
from memcomp_lightning.training import DivergedError, diverged_parameter
from memcomp_lightning.types import Configurations

log = logging.getLogger(__name__)

NEARLY_ALL = 0.99
"""Share of hidden means that makes a pass a saturated one."""

AT_AN_END = 1e-6
"""Distance from 0 or 1 below which a mean is saturated."""


class SaturationGuard(pl.Callback):
    """Stops training if a parameter is NaN, infinite or too large, or if the hidden units are stuck.

    Looks after the last update of each pass, before validation and checkpoints, so that no bad checkpoint is
    written. Hidden units are stuck if 99 % of their means given the images of that batch (``positive.h``) are
    within 1e-6 of one of their two values, in any replica, for ``patience`` passes in a row; modules that train no
    energy model, and hidden units that are real, are judged by their parameters alone. The weights of the last
    good pass are then written to ``last_good.pt``, in the folder of the checkpoint callback, else in the trainer's
    ``default_root_dir``: ``module.load_state_dict(torch.load(path))`` brings them back.

    :class:`memcomp_lightning.modules.StageModule` has a check of its own, always on, for entries beyond 1e15 or
    not finite: it protects the checkpoints of our modules and keeps no weights. Where it stops training first,
    the guard writes its file, too. The guard adds a limit of your choice, saturation, and modules of any kind.

    Args:
        largest: Largest absolute value of a parameter, > 0.
        patience: Passes in a row with stuck hidden units, >= 1.

    Raises:
        DivergedError: Naming tensor, entry and pass, or the share of stuck means, and the file.
    """

    changes_training = True

    def __init__(self, largest: float = 1e4, patience: int = 5) -> None:
        require(largest > 0, "largest", largest, "a number > 0")
        require_count("patience", patience)
        self.largest = largest
        self.patience = patience
        self._n_stuck = 0
        self._good: dict[str, Tensor] = {}
        self._good_at = ""
        self._saved = False

    def on_train_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Keep the weights that training starts with."""
        self._saved = False
        if not self._good and diverged_parameter(pl_module, self.largest) is None:
            self._keep(pl_module, f"from before pass {iteration_of(pl_module) + 1} of {prefix_of(pl_module)}")

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Judge the pass after its last update."""
        if not trainer.is_last_batch:
            return
        where = f"pass {iteration_of(pl_module) + 1} of {prefix_of(pl_module)}"
        if (diverged := diverged_parameter(pl_module, self.largest)) is not None:
            raise DivergedError(
                f"{where}: {diverged}, allowed is at most largest = {self.largest:g}. {self._save(trainer)} Go on "
                "from there with a lower learning rate, or raise SaturationGuard's largest."
            )
        stuck = self._stuck(trainer, pl_module, outputs)
        self._n_stuck = self._n_stuck + 1 if stuck >= NEARLY_ALL else 0
        if self._n_stuck >= self.patience:
            raise DivergedError(
                f"{where}: {stuck:.1%} of the hidden means given the data are within {AT_AN_END:g} of an end, for "
                f"patience = {self.patience} passes. {self._save(trainer)} Go on from there with a lower learning "
                "rate or with weight decay, or raise SaturationGuard's patience."
            )
        if not self._n_stuck:
            self._keep(pl_module, f"after {where}")

    def on_exception(self, trainer: pl.Trainer, pl_module: pl.LightningModule, exception: BaseException) -> None:
        """Write the last good weights where a module's own check stops training."""
        if isinstance(exception, DivergedError) and not self._saved:
            log.warning(self._save(trainer))

    @staticmethod
    def _stuck(trainer: pl.Trainer, module: pl.LightningModule, outputs: object) -> float:
        """Share of saturated hidden means in the worst replica, the same in every process."""
        positive = outputs.get("positive") if isinstance(outputs, dict) else None
        kind = getattr(getattr(module, "model", None), "hidden", None)
        if positive is None or not positive.h.numel() or getattr(kind, "real", False):
            return 0.0
        h = _means(positive, outputs.get("v") if isinstance(outputs, dict) else None)
        with suppress(SettingError):  # a kind of one's own need not have a form in bits
            if isinstance(kind, Units):
                at, low, width = (part.to(h.device) for part in kind.bits()[:3])
                h = (h[..., at] - low) / width
        share = (torch.minimum(h, 1 - h) <= AT_AN_END).float().mean((-1, -2)).max()
        return float(trainer.strategy.reduce(share, reduce_op="mean"))

    def _keep(self, module: pl.LightningModule, when: str) -> None:
        self._good = {name: tensor.detach().cpu().clone() for name, tensor in module.state_dict().items()}
        self._good_at = when

    def _save(self, trainer: pl.Trainer) -> str:
        """Write the last good weights; say where they are."""
        self._saved = True
        if not self._good:
            return "There are no good weights to go back to: those that training started with were bad already."
        folder = getattr(trainer.checkpoint_callback, "dirpath", None) or trainer.default_root_dir
        path = Path(folder) / "last_good.pt"
        if trainer.is_global_zero:
            write_tensors(self._good, path)
        return f"The last good weights, {self._good_at}, are in {path}."

    def state_dict(self) -> dict[str, Any]:
        """Passes with stuck units and, while there are some, the weights of the last good one."""
        good = self._good if self._n_stuck else {}
        return {"n_stuck": self._n_stuck, "good": good, "good_at": self._good_at if good else ""}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Inverse of :meth:`state_dict`; in a good pass the module's own weights are the last good ones."""
        self._n_stuck = state_dict["n_stuck"]
        self._good, self._good_at = state_dict["good"], state_dict["good_at"]


def _means(positive: Configurations, v: Tensor | None) -> Tensor:
    """Hidden means of each image, of which the positive phase may hold all hidden states with their weights."""
    h, weight = positive.h, positive.weight
    if v is None or weight is None or h.shape[-2] == v.shape[-2]:
        return h
    weight = weight.unflatten(-1, (v.shape[-2], -1)).unsqueeze(-1)
    means: Tensor = (h.unflatten(-2, (v.shape[-2], -1)) * weight).sum(-2) / weight.sum(-2)
    return means
